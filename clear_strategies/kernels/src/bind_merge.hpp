// Python binding of the merge.
#pragma once

#include <nanobind/stl/tuple.h>

#include "bind_tensors.hpp"
#include "merge.hpp"

namespace clear {

using Address = std::uintptr_t;  // of contiguous float32 in the CPU's memory, 0 for none; merge/cpp.py sees to that
using RowsOfAttribute = std::tuple<Address, Address, Address, Address, Address, Address, double, int, int, int>;

inline float* at(Address a) { return reinterpret_cast<float*>(a); }

inline ColourFactors factors_at(std::tuple<Address, Address, int> colour) {
  auto [rgb, basis, bases] = colour;
  if (bases < 1 || bases > kLanes) throw nb::value_error("the basis must have 1 to 16 columns");
  return {at(rgb), at(basis), bases};
}

// Merges attributes (out, lr, before, hr, p, anchor, stiffness, width, group, first band) in place; a colour is (rgb, basis, bases).
// Returns `counts`, and whether every number of the result is finite.
inline nb::tuple merge_gradients(std::int64_t n, const std::vector<RowsOfAttribute>& attributes, std::tuple<Address, Address, int> lr_colour,
                                 std::tuple<Address, Address, int> colour, nb::object correction, bool keeps_lr, double lambda_hr, double scale,
                                 int threads) {
  Tensors tensors;
  Merge m{.n = n, .lr = factors_at(lr_colour), .hr = factors_at(colour), .keeps_lr = keeps_lr, .lambda_hr = float(lambda_hr), .scale = float(scale)};
  if (attributes.size() > kGroups + 1) throw nb::value_error("there are at most seven attributes");
  for (auto [out, lr, before, hr, p, anchor, stiffness, width, group, first_band] : attributes) {
    if (width < 0 || width > kWidest) throw nb::value_error("an attribute must have 0 to 45 numbers a row");
    if (group < 0 || group > kGroups || (first_band == 0 && width != 3)) throw nb::value_error("no such group or band");
    m.attributes.push_back({at(lr), at(before), at(hr), first_band, at(p), at(anchor), float(stiffness), at(out), width, group});
  }
  Correction c;
  if (!correction.is_none()) c = correction_of(tensors, n, nb::cast<nb::dict>(correction));
  Merged done;
  {
    nb::gil_scoped_release release;
    done = merge(m, correction.is_none() ? nullptr : &c, threads);
  }
  return nb::make_tuple(counts(done.conflicts), done.finite);
}

inline void bind_merge(nb::module_& m) {
  m.def("merge", &merge_gradients, nb::arg("n"), nb::arg("attributes"), nb::arg("lr_colour"), nb::arg("colour"), nb::arg("correction").none(),
        nb::arg("keeps_lr"), nb::arg("lambda_hr"), nb::arg("scale"), nb::arg("threads"));
}

}  // namespace clear
