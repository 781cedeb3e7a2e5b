// The windows of a plane sweep (geometry/dense_stereo/cost.py), and its binding.
#pragma once

#include "tensor.hpp"

namespace clear {

// A photo with the mean of its windows, and another photo that is drawn onto its pixels.
struct Sweep {
  const float *image, *mean;  // [height, width]
  int height, width;
  const float *rotated, *shift;  // [3, height, width] and [3]: a pixel's point at inverse depth d projects to rotated + d shift
  const float* other;            // [other_height, other_width]
  int other_height, other_width, window;
};

// Writes, for each plane and pixel [planes, height, width], the covariance of the photo's window with that of the other photo
// drawn through the plane, 0 where the other photo does not see it, and the variance of the drawn window.
void sweep(const Sweep& s, const float* inverse_depths, int planes, float* covariances, float* variances, int threads);

inline void bind_sweep(nanobind::module_& m) {
  namespace nb = nanobind;
  using Line = Tensor<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
  using Map = Tensor<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
  using Maps = Tensor<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
  using Out = Tensor<float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
  m.def("sweep", [](const Map& image, const Map& mean, const Maps& rotated, const Line& shift, const Map& other, const Line& depths,
                    int window, const Out& covariances, const Out& variances, int threads) {
    const auto fits = [&](const auto& maps, std::size_t n) {
      return maps.shape(0) == n && maps.shape(1) == image.shape(0) && maps.shape(2) == image.shape(1);
    };
    if (mean.shape(0) != image.shape(0) || mean.shape(1) != image.shape(1) || !fits(rotated, 3) || shift.size() != 3 ||
        !fits(covariances, depths.size()) || !fits(variances, depths.size()) || !image.size() || !other.size())
      throw nb::value_error("a map has another size than the image, or there is not one for each plane");
    const Sweep s{image.data(), mean.data(), int(image.shape(0)), int(image.shape(1)), rotated.data(), shift.data(),
                  other.data(), int(other.shape(0)), int(other.shape(1)), window};
    nb::gil_scoped_release free;
    sweep(s, depths.data(), int(depths.size()), covariances.data(), variances.data(), threads);
  });
}

}  // namespace clear
