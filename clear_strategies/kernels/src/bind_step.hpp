// Python bindings of the per-Gaussian step: checks the tensors' types and shapes and takes their pointers.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/vector.h>

#include <string>
#include <vector>

#include "step.hpp"

namespace clear {

namespace nb = nanobind;

// Hands out pointers to tensors, and keeps those tensors alive.
class Tensors {
 public:
  // `table[name]` as n rows of `width` numbers; null if it is None and optional.
  template <class T>
  T* rows(const nb::dict& table, const char* name, std::int64_t n, std::int64_t width, bool optional = false) {
    if (!table.contains(name)) throw nb::key_error(name);
    nb::handle value = table[name];
    if (value.is_none() && optional) return nullptr;
    nb::ndarray<T, nb::c_contig, nb::device::cpu> array;
    if (!nb::try_cast(value, array, false))
      throw nb::type_error((std::string(name) + " must be a contiguous float32 tensor in the CPU's memory").c_str());
    bool fits = array.ndim() >= 1 && std::int64_t(array.shape(0)) == n && std::int64_t(array.size()) == n * width;
    if (!fits) {
      std::string found;
      for (std::size_t d = 0; d < array.ndim(); ++d) found += (d ? ", " : "") + std::to_string(array.shape(d));
      throw nb::value_error((std::string(name) + " must have " + std::to_string(n) + " rows of " + std::to_string(width) +
                             " numbers, got shape (" + found + ")").c_str());
    }
    T* data = array.data();
    kept_.push_back(nb::cast(array));
    return data;
  }

 private:
  std::vector<nb::object> kept_;
};

// The gradients of one view, and the two passes over them: compare and step.
class GaussianStep {
 public:
  GaussianStep(nb::dict activation, nb::dict lr, nb::object base, nb::object hf, std::int64_t bases, double lambda_hf) {
    if (bases < 1 || bases > kLanes) throw nb::value_error("the basis must have 1 to 16 columns");
    std::int64_t n = g_.n = std::int64_t(nb::len(nb::object(activation["sigmoid"])));
    g_.bases = int(bases);
    g_.lambda_hf = float(lambda_hf);
    g_.activation = {tensors_.rows<const float>(activation, "scales", n, 3), tensors_.rows<const float>(activation, "filtered", n, 3),
                     tensors_.rows<const float>(activation, "filter", n, 1), tensors_.rows<const float>(activation, "sigmoid", n, 1),
                     tensors_.rows<const float>(activation, "factor", n, 1)};
    g_.route = tensors_.rows<const float>(activation, "route", n, 1, true);
    g_.lr = gradient(lr);
    if (!base.is_none()) g_.base = gradient(nb::cast<nb::dict>(base));
    if (!hf.is_none()) g_.hf = gradient(nb::cast<nb::dict>(hf));
    if (base.is_none() && !hf.is_none()) throw nb::value_error("hf needs base");
  }

  // Returns (comparable, opposed) by group.
  nb::tuple compare(int threads) const {
    if (g_.n && !g_.base) throw nb::value_error("there is no HR gradient to compare with");
    Comparison c;
    {
      nb::gil_scoped_release release;
      c = clear::compare(g_, threads);
    }
    return nb::make_tuple(list(c.comparable), list(c.opposed));
  }

  // Steps `attributes` {name: {p, m, v, anchor, merged, width, stiffness, rate, keep, limit}} in place.
  // Returns (corrected rows, Σ ω, rows with ω at its lower bound) by group, and still rows.
  nb::tuple step(nb::dict attributes, nb::object correction, nb::dict settings, int threads) const {
    Tensors tensors;
    Step s;
    for (auto [name, attribute] : {std::pair{"means", &s.means}, {"quats", &s.quats}, {"scales", &s.scales},
                                   {"opacities", &s.opacities}, {"sh0", &s.sh0}, {"shN", &s.shN}, {"detail", &s.detail}})
      *attribute = parameter(tensors, nb::cast<nb::dict>(attributes[name]));
    for (auto [attribute, width] : {std::pair{&s.means, 3}, {&s.quats, 4}, {&s.scales, 3}, {&s.opacities, 1}, {&s.sh0, 3}, {&s.detail, 3}})
      if (attribute->width != width) throw nb::value_error("an attribute has another width than its gradient");
    auto number = [&](const char* name) { return nb::cast<double>(settings[name]); };
    double beta1 = number("beta1"), beta2 = number("beta2");
    s.adam = {float(beta1), float(beta2), float(1 - beta1), float(1 - beta2), float(1 / number("bias2")), float(number("eps"))};
    s.lambda_hr = float(number("lambda_hr"));
    s.skips = nb::cast<bool>(settings["skips"]);
    s.width = nb::cast<int>(settings["width"]);
    if (s.width % 3 || s.width < 3 * (g_.bases - 1) || s.width > s.shN.width || s.width > 45)
      throw nb::value_error("width must be a multiple of 3 between the active bands' numbers and an shN row's");
    Correction c;
    bool corrects = !correction.is_none();
    if (corrects) {
      if (g_.n && !g_.base) throw nb::value_error("there is no HR gradient to correct");
      c = correction_of(tensors, nb::cast<nb::dict>(correction));
    }
    Stepped done;
    {
      nb::gil_scoped_release release;
      done = clear::step(g_, corrects ? &c : nullptr, s, threads);
    }
    return nb::make_tuple(list(done.corrected.rows), list(done.corrected.omega), list(done.corrected.at_lower_bound),
                          done.still);
  }

 private:
  Gradients g_{};
  Tensors tensors_;

  SplatGradient gradient(const nb::dict& t) {
    std::int64_t n = g_.n;
    return {tensors_.rows<const float>(t, "means", n, 3), tensors_.rows<const float>(t, "quats", n, 4),
            tensors_.rows<const float>(t, "scales", n, 3), tensors_.rows<const float>(t, "opacities", n, 1),
            tensors_.rows<const float>(t, "rgb", n, 3), tensors_.rows<const float>(t, "basis", n, g_.bases)};
  }

  Attribute parameter(Tensors& tensors, const nb::dict& t) const {
    auto number = [&](const char* name) { return float(nb::cast<double>(t[name])); };
    Attribute a;
    a.width = nb::cast<int>(t["width"]);
    a.p = tensors.rows<float>(t, "p", g_.n, a.width);
    a.m = tensors.rows<float>(t, "m", g_.n, a.width);
    a.v = tensors.rows<float>(t, "v", g_.n, a.width);
    a.anchor = tensors.rows<const float>(t, "anchor", g_.n, a.width, true);
    a.merged = tensors.rows<float>(t, "merged", g_.n, a.width, true);
    a.stiffness = number("stiffness"), a.rate = -number("rate"), a.keep = number("keep"), a.limit = number("limit");
    return a;
  }

  Correction correction_of(Tensors& tensors, const nb::dict& t) const {
    auto number = [&](const char* name) { return nb::cast<double>(t[name]); };
    Correction c;
    auto groups = nb::cast<std::vector<bool>>(t["groups"]);
    if (groups.size() != kGroups) throw nb::value_error("groups must have one entry per conflict group");
    for (int k = 0; k < kGroups; ++k) c.corrects[k] = groups[k];
    c.tolerance = number("tolerance"), c.weight_min = number("weight_min"), c.weight_max = number("weight_max");
    c.rotation_noise = number("rotation_noise");
    c.reliability = tensors.rows<const float>(t, "reliability", g_.n, 1, true);
    return c;
  }

  template <class T, std::size_t K>
  static nb::list list(const T (&values)[K]) {
    nb::list out;
    for (const T& value : values) out.append(value);
    return out;
  }
};

inline void bind_step(nb::module_& m) {
  nb::class_<GaussianStep>(m, "GaussianStep")
      .def(nb::init<nb::dict, nb::dict, nb::object, nb::object, std::int64_t, double>(), nb::arg("activation"), nb::arg("lr"),
           nb::arg("base").none(), nb::arg("hf").none(), nb::arg("bases"), nb::arg("lambda_hf"))
      .def("compare", &GaussianStep::compare, nb::arg("threads"))
      .def("step", &GaussianStep::step, nb::arg("attributes"), nb::arg("correction").none(), nb::arg("settings"),
           nb::arg("threads"));
}

}  // namespace clear
