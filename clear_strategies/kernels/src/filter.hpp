// The 3D filter's loop over Gaussians and cameras, and its binding.
#pragma once

#include <cstdint>

#include "tensor.hpp"

namespace clear {

inline constexpr int kCameraNumbers = 20;  // the rows of [R | t], fx, fy, cx, cy, the smallest and the largest u, and those of v

// The smallest depth beyond `near` among the cameras that see each centre; infinite where none does.
void nearest_depths(const float* means, std::int64_t n, const float* cameras, std::int64_t count, float near, float* depths,
                    int threads);

inline void bind_filter(nanobind::module_& m) {
  namespace nb = nanobind;
  using Rows = Tensor<const float, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
  using Depths = Tensor<float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
  m.def("nearest_depths", [](const Rows& means, const Rows& cameras, float near, const Depths& depths, int threads) {
    if (means.shape(1) != 3 || cameras.shape(1) != kCameraNumbers || depths.shape(0) != means.shape(0))
      throw nb::value_error("means must be [N, 3], cameras [V, 20] and depths [N]");
    nb::gil_scoped_release free;
    nearest_depths(means.data(), std::int64_t(means.shape(0)), cameras.data(), std::int64_t(cameras.shape(0)), near,
                   depths.data(), threads);
  });
}

}  // namespace clear
