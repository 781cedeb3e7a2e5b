// MCMC's noise (density/mcmc.py), and its binding.
#pragma once

#include <cstdint>

#include "tensor.hpp"

namespace clear {

struct Field {
  float* means;
  const float *quats, *scales, *gate;  // scales: their logarithms
  std::int64_t n;
};

// means[i] += strength / s · gate[i] · Σ_i η for the Gaussians i of `rows`, where s is the median of the largest scales.
void wander(const Field& field, const std::int64_t* rows, const float* eta, std::int64_t count, float strength, int threads);

inline void bind_wander(nanobind::module_& m) {
  namespace nb = nanobind;
  using Rows = Tensor<const float, nb::shape<-1, -1>, nb::c_contig, nb::device::cpu>;
  using Means = Tensor<float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
  using Gate = Tensor<const float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
  using Indices = Tensor<const std::int64_t, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
  m.def("wander", [](const Means& means, const Rows& quats, const Rows& scales, const Gate& gate, const Indices& rows,
                     const Rows& eta, float strength, int threads) {
    const std::size_t n = means.shape(0), count = rows.shape(0);
    if (quats.shape(0) != n || quats.shape(1) != 4 || scales.shape(0) != n || scales.shape(1) != 3 || gate.shape(0) != n ||
        eta.shape(0) != count || eta.shape(1) != 3)
      throw nb::value_error("means must be [N, 3], quats [N, 4], scales [N, 3], gate [N], rows [M] and eta [M, 3]");
    for (std::size_t k = 0; k < count; ++k)
      if (std::uint64_t(rows.data()[k]) >= n) throw nb::index_error("rows must lie in [0, N)");
    nb::gil_scoped_release free;
    wander({means.data(), quats.data(), scales.data(), gate.data(), std::int64_t(n)}, rows.data(), eta.data(),
           std::int64_t(count), strength, threads);
  });
}

}  // namespace clear
