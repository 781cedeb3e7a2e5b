// The activation of the raw parameters (training/field.py), and its binding.
#pragma once

#include <cstdint>
#include <optional>

#include <nanobind/stl/optional.h>

#include "block.hpp"
#include "pool.hpp"
#include "tensor.hpp"

namespace clear {

struct RawColumns {
  const float *scales, *opacities;  // logarithms and logits
  const float *filter, *gate;       // gate may be null: 1
  std::int64_t n;
};

struct ActivatedColumns {
  float *scales, *filtered, *sigmoid, *coefficient, *factor, *opacities;
};

// As kernels/per_gaussian/reference.py.
inline void activate(const RawColumns& raw, const ActivatedColumns& to, int threads) {
  Pool::instance().run(threads, chunks(raw.n), [&](std::int64_t number) {
    each_sixteen(raw.n, number, [&](std::int64_t i, int count) CLEAR_LAMBDA {
      Floats s[3], filtered[3], coefficient = 1.0f, f = load_some(raw.filter + i, count);
      load_columns(raw.scales + 3 * i, count, s);
      for (int d = 0; d < 3; ++d) {
        s[d] = exponential(s[d]);
        filtered[d] = maximum(s[d], root(s[d] * s[d] + f * f));  // s where the squares vanish
        coefficient *= s[d] / filtered[d];
      }
      const Floats sigmoid = Floats(1.0f) / (Floats(1.0f) + exponential(-load_some(raw.opacities + i, count)));
      const Floats factor = raw.gate ? coefficient * load_some(raw.gate + i, count) : coefficient;
      store_rows(to.scales, i, count, s);
      store_rows(to.filtered, i, count, filtered);
      store_some(to.sigmoid + i, sigmoid, count);
      store_some(to.coefficient + i, coefficient, count);
      store_some(to.factor + i, factor, count);
      store_some(to.opacities + i, factor * sigmoid, count);
    });
  });
}

inline void bind_activate(nanobind::module_& m) {
  namespace nb = nanobind;
  using Scales = Tensor<const float, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
  using Row = Tensor<const float, nb::shape<-1>, nb::c_contig, nb::device::cpu>;
  using Rows = Tensor<float, nb::shape<2, -1, 3>, nb::c_contig, nb::device::cpu>;
  using Columns = Tensor<float, nb::shape<4, -1>, nb::c_contig, nb::device::cpu>;
  m.def(
      "activate",
      [](const Scales& scales, const Row& opacities, const Row& filter, const std::optional<Row>& gate, const Rows& rows,
         const Columns& columns, int threads) {
        const std::size_t n = opacities.shape(0);
        if (scales.shape(0) != n || filter.shape(0) != n || (gate && gate->shape(0) != n) || rows.shape(1) != n ||
            columns.shape(1) != n)
          throw nb::value_error("scales must be [N, 3], opacities, filter and gate [N], rows [2, N, 3] and columns [4, N]");
        const RawColumns raw{scales.data(), opacities.data(), filter.data(), gate ? gate->data() : nullptr, std::int64_t(n)};
        float *r = rows.data(), *c = columns.data();
        nb::gil_scoped_release free;
        activate(raw, {r, r + 3 * n, c, c + n, c + 2 * n, c + 3 * n}, threads);
      },
      nb::arg("scales"), nb::arg("opacities"), nb::arg("filter"), nb::arg("gate").none(), nb::arg("rows"), nb::arg("columns"),
      nb::arg("threads"));
}

}  // namespace clear
