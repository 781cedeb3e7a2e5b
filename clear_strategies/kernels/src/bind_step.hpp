// Python bindings of the per-Gaussian step.
#pragma once

#include "bind_tensors.hpp"
#include "step.hpp"

namespace clear {

// The gradients of one view, and the pass over them.
class GaussianStep {
 public:
  GaussianStep(nb::dict activation, nb::dict lr, nb::object hr, std::int64_t bases) {
    if (bases < 1 || bases > kLanes) throw nb::value_error("the basis must have 1 to 16 columns");
    std::int64_t n = g_.n = std::int64_t(nb::len(nb::object(activation["sigmoid"])));
    g_.bases = int(bases);
    auto rows = [&](const char* name, std::int64_t width) { return tensors_.rows<const float>(activation, name, n, width); };
    g_.activation = {rows("scales", 3), rows("filtered", 3), rows("filter", 1), rows("sigmoid", 1), rows("factor", 1)};
    g_.basis = rows("basis", bases);
    g_.lr = gradient(lr);
    if (hr.is_none()) return;
    nb::dict high = nb::cast<nb::dict>(hr);
    g_.hr = gradient(high);
    if (high.contains("detail")) g_.detail = tensors_.rows<const float>(high, "detail", n, 3);
  }

  // Writes the inner products of both gradients to `to`, float64 [3, 6, n]; returns `counts`.
  nb::tuple products(Address to, int threads) const {
    if (g_.n && !g_.hr) throw nb::value_error("there is no HR gradient to reconcile");
    nb::gil_scoped_release release;
    Conflicts found = clear::products(g_, {at<double>(to), g_.n}, threads);
    nb::gil_scoped_acquire acquire;
    return counts(found);
  }

  // Steps `attributes` {name: {p, m, v, hr, plus, width, rate, keep, limit}} in place; returns the number of still rows.
  std::int64_t step(nb::dict attributes, const WeightTables& weights, nb::dict settings, int threads) const {
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
    nb::gil_scoped_release release;
    return clear::step(g_, weights_at(weights), s, threads);
  }

 private:
  Gradients g_{};
  Tensors tensors_;

  SplatGradient gradient(const nb::dict& t) {
    std::int64_t n = g_.n;
    return {tensors_.rows<const float>(t, "means", n, 3), tensors_.rows<const float>(t, "quats", n, 4),
            tensors_.rows<const float>(t, "scales", n, 3), tensors_.rows<const float>(t, "opacities", n, 1),
            tensors_.rows<const float>(t, "rgb", n, 3)};
  }

  Attribute parameter(Tensors& tensors, const nb::dict& t) const {
    auto number = [&](const char* name) { return float(nb::cast<double>(t[name])); };
    Attribute a;
    a.width = nb::cast<int>(t["width"]);
    a.p = tensors.rows<float>(t, "p", g_.n, a.width);
    a.m = tensors.rows<float>(t, "m", g_.n, a.width);
    a.v = tensors.rows<float>(t, "v", g_.n, a.width);
    a.hr = tensors.rows<const float>(t, "hr", g_.n, a.width, true);
    a.plus = tensors.rows<const float>(t, "plus", g_.n, a.width, true);
    a.rate = -number("rate"), a.keep = number("keep"), a.limit = number("limit");
    return a;
  }
};

inline void bind_step(nb::module_& m) {
  nb::class_<GaussianStep>(m, "GaussianStep")
      .def(nb::init<nb::dict, nb::dict, nb::object, std::int64_t>(), nb::arg("activation"), nb::arg("lr"), nb::arg("hr").none(),
           nb::arg("bases"))
      .def("products", &GaussianStep::products)
      .def("step", &GaussianStep::step);
}

}  // namespace clear
