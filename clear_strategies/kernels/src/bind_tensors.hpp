// What the bindings of the per-Gaussian passes share: pointers to tensors whose types and shapes are checked, the rule of a
// correction, and counts.
#pragma once

#include <nanobind/stl/vector.h>

#include <string>
#include <vector>

#include "conflict.hpp"
#include "tensor.hpp"

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
    Tensor<T, nb::c_contig, nb::device::cpu> array;
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
    kept_.emplace_back(array.handle());
    return data;
  }

 private:
  std::vector<nb::ndarray<>> kept_;
};

inline Correction correction_of(Tensors& tensors, std::int64_t n, const nb::dict& t) {
  auto number = [&](const char* name) { return nb::cast<double>(t[name]); };
  Correction c;
  auto groups = nb::cast<std::vector<bool>>(t["groups"]);
  if (groups.size() != kGroups) throw nb::value_error("groups must have one entry per conflict group");
  for (int k = 0; k < kGroups; ++k) c.corrects[k] = groups[k];
  c.tolerance = number("tolerance"), c.weight_min = number("weight_min"), c.weight_max = number("weight_max");
  c.rotation_noise = number("rotation_noise");
  c.reliability = tensors.rows<const float>(t, "reliability", n, 1, true);
  return c;
}

template <class T, std::size_t K>
nb::list list(const T (&values)[K]) {
  nb::list out;
  for (const T& value : values) out.append(value);
  return out;
}

// (comparable, opposed, corrected, Σ ω, at the lower bound) by group.
inline nb::tuple counts(const Conflicts& c) {
  return nb::make_tuple(list(c.comparable), list(c.opposed), list(c.corrected), list(c.omega), list(c.at_lower_bound));
}

}  // namespace clear
