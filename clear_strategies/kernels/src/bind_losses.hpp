// Python bindings of the image losses. Images are contiguous float32 [H, W, 3] on the CPU, as is the gradient's output.
#pragma once

#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include <algorithm>
#include <optional>
#include <stdexcept>
#include <utility>

#include "haar.hpp"
#include "photometric.hpp"
#include "tensor.hpp"

namespace clear {

template <class T>
using Image = Tensor<T, nanobind::shape<-1, -1, kChannels>, nanobind::c_contig, nanobind::device::cpu>;
using ImageIn = Image<const float>;
using ImageOut = Image<float>;

inline ImagePair same_size(const ImageIn& x, const ImageIn& y, const std::optional<ImageOut>& gradient) {
  for (std::size_t axis : {0, 1})
    if (x.shape(axis) != y.shape(axis) || (gradient && x.shape(axis) != gradient->shape(axis)) || x.shape(axis) == 0)
      throw std::invalid_argument("the images and the gradient must have the same size, at least one pixel.");
  return {x.data(), y.data(), gradient ? gradient->data() : nullptr, int(x.shape(0)), int(x.shape(1)) * kChannels};
}

inline void bind_losses(nanobind::module_& m) {
  namespace nb = nanobind;
  using namespace nb::literals;
  m.def(
      "photometric",
      [](const ImageIn& x, const ImageIn& y, const std::optional<ImageOut>& gradient, float l1, float dssim, int inset, int threads) {
        ImagePair images = same_size(x, y, gradient);
        if (inset < 0 || 2 * inset >= int(std::min(x.shape(0), x.shape(1))))
          throw std::invalid_argument("no window lies so far inside the images.");
        nb::gil_scoped_release free;
        PhotometricMeans means = photometric(images, {l1, dssim}, inset, threads);
        return std::pair(means.l1, means.dssim);
      },
      "x"_a, "y"_a, "gradient"_a.none(), "l1"_a, "dssim"_a, "inset"_a, "threads"_a,
      "Writes the gradient of l1 * mean|x - y| + dssim * (1 - SSIM); returns (mean|x - y|, 1 - SSIM), without a gradient (0, 1 - SSIM).");
  // Writes the gradient of the mean absolute Haar detail of x - y; returns its value.
  m.def("haar_l1", [](const ImageIn& x, const ImageIn& y, const ImageOut& gradient, int levels, int threads) {
    ImagePair images = same_size(x, y, gradient);
    nb::gil_scoped_release free;
    return haar_l1(images, levels, threads);
  });
}

}  // namespace clear
