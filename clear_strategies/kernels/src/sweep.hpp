// The cost volume of a plane sweep (geometry/dense_stereo/cost.py), and its binding.
#pragma once

#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <tuple>
#include <vector>

#include "tensor.hpp"

namespace clear {

// Another photo that is drawn onto the pixels of the photo.
struct Swept {
  const float *rotated, *shift;  // [3, height, width] of the photo and [3]: a pixel's point at depth 1/d projects to rotated + d shift
  const float* image;            // [height, width], of its own size
  int height, width;
};

// A photo with the mean and the standard deviation of its windows, and the photos that it is compared with.
struct Sweep {
  const float *image, *mean, *deviation;  // [height, width]
  int height, width, window;
  float floor;  // added to the variance of a drawn window
  std::vector<Swept> others;
};

// Writes (1 - ZNCC) / 2 for each pixel and plane [height, width, planes]: the mean over the better half of the other photos, and
// 0.5 of one that does not see the pixel there.
void cost_volume(const Sweep& s, const float* inverse_depths, int planes, float* volume, int threads);

inline void bind_sweep(nanobind::module_& m) {
  namespace nb = nanobind;
  using Line = Tensor<const float, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
  using Map = Tensor<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
  using Maps = Tensor<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
  using Out = Tensor<float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
  m.def("cost_volume", [](const Map& image, const Map& mean, const Map& deviation, const std::vector<std::tuple<Maps, Line, Map>>& others,
                          const Line& depths, int window, float floor, const Out& volume, int threads) {
    const auto fits = [&](const auto& map, std::size_t first) {
      return map.shape(first) == image.shape(0) && map.shape(first + 1) == image.shape(1);
    };
    Sweep s{image.data(), mean.data(), deviation.data(), int(image.shape(0)), int(image.shape(1)), window, floor, {}};
    bool good = image.size() && others.size() && fits(mean, 0) && fits(deviation, 0) && fits(volume, 0) && volume.shape(2) == depths.size();
    for (const auto& [rotated, shift, other] : others) {
      good = good && rotated.shape(0) == 3 && fits(rotated, 1) && shift.size() == 3 && other.size();
      s.others.push_back({rotated.data(), shift.data(), other.data(), int(other.shape(0)), int(other.shape(1))});
    }
    if (!good) throw nb::value_error("a map has another size than the image, or there is not one for each plane");
    nb::gil_scoped_release free;
    cost_volume(s, depths.data(), int(depths.size()), volume.data(), threads);
  });
}

}  // namespace clear
