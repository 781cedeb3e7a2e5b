// Semi-global smoothing of a cost volume (geometry/dense_stereo/smoothing.py), and its binding.
#pragma once

#include "tensor.hpp"

namespace clear {

struct CostVolume {
  const float* cost;  // [height, width, planes]
  const float* grey;  // [height, width]
  int height, width, planes;
};

// Adds L of the paths from all eight directions to `total` [height, width, planes].
void add_paths(const CostVolume& volume, float small_step, float large_step, float* total);

inline void bind_smooth(nanobind::module_& m) {
  namespace nb = nanobind;
  using Volume = Tensor<const float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
  using Map = Tensor<const float, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
  using Out = Tensor<float, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
  m.def("add_paths", [](const Volume& cost, const Map& grey, float small_step, float large_step, const Out& total) {
    for (int axis = 0; axis < 3; ++axis)
      if (total.shape(axis) != cost.shape(axis) || (axis < 2 && grey.shape(axis) != cost.shape(axis)))
        throw nb::value_error("the image and the sum must have the size of the cost volume");
    const CostVolume volume{cost.data(), grey.data(), int(cost.shape(0)), int(cost.shape(1)), int(cost.shape(2))};
    nb::gil_scoped_release free;
    add_paths(volume, small_step, large_step, total.data());
  });
}

}  // namespace clear
