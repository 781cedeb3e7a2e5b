// Whether all numbers of some tensors are finite, in one call.
#pragma once

#include <nanobind/stl/vector.h>

#include <cstdint>
#include <cstring>
#include <vector>

#include "tensor.hpp"

namespace clear {

inline bool all_finite(const float* numbers, std::size_t count) {
  constexpr std::size_t kBlock = 4096;  // numbers between two looks at what was found
  for (std::size_t from = 0; from < count; from += kBlock) {
    std::uint32_t found = 0;
    for (std::size_t k = from, end = from + kBlock < count ? from + kBlock : count; k < end; ++k) {
      std::uint32_t bits;
      std::memcpy(&bits, numbers + k, sizeof bits);
      found |= (bits & 0x7f800000u) == 0x7f800000u;  // the exponent of infinity and NaN
    }
    if (found) return false;
  }
  return true;
}

inline void bind_finite(nanobind::module_& m) {
  using Numbers = Tensor<const float, nanobind::c_contig, nanobind::device::cpu>;
  m.def("all_finite", [](const std::vector<Numbers>& tensors) {
    nanobind::gil_scoped_release free;
    for (const Numbers& x : tensors)
      if (!all_finite(x.data(), x.size())) return false;
    return true;
  });
}

}  // namespace clear
