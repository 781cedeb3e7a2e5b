// Python bindings of the reconciliation of two gradients.
#pragma once

#include <nanobind/stl/tuple.h>

#include "bind_tensors.hpp"
#include "reconcile.hpp"

namespace clear {

using RowsOfAttribute = std::tuple<Address, Address, Address, Address, int, int, int>;
using ColourFactors = std::tuple<Address, Address, int>;

inline Colour colour_at(const ColourFactors& colour) {
  auto [rgb, basis, bases] = colour;
  if (bases < 1 || bases > kLanes) throw nb::value_error("the basis must have 1 to 16 columns");
  return {at<float>(rgb), at<float>(basis), bases};
}

// Attributes (lr, hr, plus, out, width, group, first band), and colours (rgb, basis, bases).
inline TwoGradients two_gradients(std::int64_t n, const std::vector<RowsOfAttribute>& attributes, const ColourFactors& lr,
                                  const ColourFactors& hr) {
  TwoGradients g{.n = n, .attributes = {}, .lr = colour_at(lr), .hr = colour_at(hr)};
  for (auto [low, high, plus, out, width, group, first_band] : attributes) {
    if (width < 0 || width > kWidest) throw nb::value_error("an attribute must have 0 to 45 numbers a row");
    if (group < 0 || group > kGroups || (first_band == 0 && width != 3)) throw nb::value_error("no such group or band");
    g.attributes.push_back({at<float>(low), at<float>(high), width, group, first_band, at<float>(plus), at<float>(out)});
  }
  return g;
}

inline void bind_reconcile(nb::module_& m) {
  m.def("products", [](std::int64_t n, const std::vector<RowsOfAttribute>& attributes, const ColourFactors& lr,
                       const ColourFactors& hr, Address to, int threads) {
    TwoGradients g = two_gradients(n, attributes, lr, hr);
    nb::gil_scoped_release release;
    Conflicts found = products(g, {at<double>(to), n}, threads);
    nb::gil_scoped_acquire acquire;
    return counts(found);
  });
  m.def("apply", [](std::int64_t n, const std::vector<RowsOfAttribute>& attributes, const ColourFactors& lr,
                    const ColourFactors& hr, const WeightTables& weights, double lambda_hr, bool keeps_lr, int threads) {
    TwoGradients g = two_gradients(n, attributes, lr, hr);
    nb::gil_scoped_release release;
    return apply(g, weights_at(weights), float(lambda_hr), keeps_lr, threads);
  });
}

}  // namespace clear
