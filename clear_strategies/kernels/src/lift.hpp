// How a patch map reaches a Gaussian (strategies/p2g.py), and its binding.
#pragma once

#include <algorithm>
#include <cstdint>

#include "pool.hpp"
#include "tensor.hpp"

namespace clear {

struct Patches {
  const float* maps;  // [count, height, width]
  std::int64_t count;
  int height, width;
  float edge;  // of a patch, pixels
};

// The maps' values at the patch of each centre: outside the image the border's, 0 for an invisible Gaussian.  Eq. 10
inline void lift(const Patches& p, const float* centers, const bool* visible, std::int64_t n, float* out, int threads) {
  constexpr std::int64_t chunk = 4096;  // Gaussians per task
  const std::int64_t size = std::int64_t(p.height) * p.width;
  auto inside = [](float at, int patches) { return at > 0.0f ? int(std::min(at, float(patches - 1))) : 0; };
  Pool::instance().run(threads, (n + chunk - 1) / chunk, [&](std::int64_t number) {
    for (std::int64_t i = number * chunk, end = std::min(n, i + chunk); i < end; ++i) {
      const int column = inside(centers[2 * i] / p.edge, p.width), row = inside(centers[2 * i + 1] / p.edge, p.height);
      const float* map = p.maps + std::int64_t(row) * p.width + column;
      for (std::int64_t c = 0; c < p.count; ++c) out[c * n + i] = visible[i] ? map[c * size] : 0.0f;
    }
  });
}

inline void bind_lift(nanobind::module_& m) {
  namespace nb = nanobind;
  using Maps = Tensor<const float, nb::shape<-1, -1, -1>, nb::c_contig, nb::device::cpu>;
  using Centers = Tensor<const float, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;
  using Visible = Tensor<const bool, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
  using Out = Tensor<float, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
  m.def(
      "lift",
      [](const Maps& maps, const Centers& centers, const Visible& visible, float edge, const Out& out, int threads) {
        const std::size_t n = visible.shape(0);
        if (centers.shape(0) != n || out.shape(0) != maps.shape(0) || out.shape(1) != n || !maps.size())
          throw nb::value_error("maps must be [C, ph, pw], centers [N, 2], visible [N] and out [C, N]");
        const Patches p{maps.data(), std::int64_t(maps.shape(0)), int(maps.shape(1)), int(maps.shape(2)), edge};
        nb::gil_scoped_release free;
        lift(p, centers.data(), visible.data(), std::int64_t(n), out.data(), threads);
      },
      nb::arg("maps").noconvert(), nb::arg("centers").noconvert(), nb::arg("visible").noconvert(), nb::arg("edge"),
      nb::arg("out").noconvert(), nb::arg("threads"));
}

}  // namespace clear
