// What the bindings of the per-Gaussian passes share: pointers to tensors whose types and shapes are checked, weights, and counts.
#pragma once

#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <string>
#include <vector>

#include "products.hpp"
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

using Address = std::uintptr_t;  // of contiguous memory of the CPU, 0 for none; the Python side sees to that

template <class T>
T* at(Address a) {
  return reinterpret_cast<T*>(a);
}

// keep and remove: a number, and float64 rows that take its place where there are any, with the distance from one group to the next.
using WeightTable = std::tuple<double, Address, std::int64_t>;
using WeightTables = std::tuple<WeightTable, WeightTable>;

inline Weights weights_at(const WeightTables& tables) {
  auto weight = [](const WeightTable& t) { return Weight{std::get<0>(t), at<double>(std::get<1>(t)), std::get<2>(t)}; };
  return {weight(std::get<0>(tables)), weight(std::get<1>(tables))};
}

template <class T, std::size_t K>
nb::list list(const T (&values)[K]) {
  nb::list out;
  for (const T& value : values) out.append(value);
  return out;
}

// (comparable, opposed) by group.
inline nb::tuple counts(const Conflicts& c) { return nb::make_tuple(list(c.comparable), list(c.opposed)); }

}  // namespace clear
