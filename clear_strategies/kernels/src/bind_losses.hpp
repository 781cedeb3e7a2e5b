// Python bindings of the image losses. Images are contiguous float32 [H, W, 3] on the CPU, as is the gradient's output.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>

#include <stdexcept>
#include <utility>

#include "haar.hpp"
#include "photometric.hpp"

namespace clear {

template <class T>
using Image = nanobind::ndarray<T, nanobind::shape<-1, -1, kChannels>, nanobind::c_contig, nanobind::device::cpu>;
using ImageIn = Image<const float>;
using ImageOut = Image<float>;

inline ImagePair same_size(const ImageIn& x, const ImageIn& y, const ImageOut& gradient) {
  for (std::size_t axis : {0, 1})
    if (x.shape(axis) != y.shape(axis) || x.shape(axis) != gradient.shape(axis) || x.shape(axis) == 0)
      throw std::invalid_argument("the images and the gradient must have the same size, at least one pixel.");
  return {x.data(), y.data(), gradient.data(), int(x.shape(0)), int(x.shape(1)) * kChannels};
}

inline void bind_losses(nanobind::module_& m) {
  namespace nb = nanobind;
  using namespace nb::literals;
  m.def(
      "photometric",
      [](const ImageIn& x, const ImageIn& y, const ImageOut& gradient, float l1, float dssim, int threads) {
        ImagePair images = same_size(x, y, gradient);
        nb::gil_scoped_release free;
        PhotometricMeans means = photometric(images, {l1, dssim}, threads);
        return std::pair(means.l1, means.dssim);
      },
      "x"_a.noconvert(), "y"_a.noconvert(), "gradient"_a.noconvert(), "l1"_a, "dssim"_a, "threads"_a,
      "Writes the gradient of l1 * mean|x - y| + dssim * (1 - SSIM); returns (mean|x - y|, 1 - SSIM).");
  m.def(
      "haar_l1",
      [](const ImageIn& x, const ImageIn& y, const ImageOut& gradient, int levels, int threads) {
        ImagePair images = same_size(x, y, gradient);
        nb::gil_scoped_release free;
        return haar_l1(images, levels, threads);
      },
      "x"_a.noconvert(), "y"_a.noconvert(), "gradient"_a.noconvert(), "levels"_a, "threads"_a,
      "Writes the gradient of the mean absolute Haar detail of x - y; returns its value.");
}

}  // namespace clear
