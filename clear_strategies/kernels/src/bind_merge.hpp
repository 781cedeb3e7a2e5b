// Python binding of the merge.
#pragma once

#include "bind_tensors.hpp"
#include "merge.hpp"

namespace clear {

// Merges `attributes` [{lr, before, hr, first_band, p, anchor, stiffness, out, width, group}] in place; `colour` is {rgb, basis, bases}
// or None. Returns `counts`, and whether every number of the result is finite.
inline nb::tuple merge_gradients(std::int64_t n, nb::list attributes, nb::object colour, nb::object correction, bool keeps_lr,
                                 double lambda_hr, double scale, int threads) {
  Tensors tensors;
  Merge m{.n = n, .keeps_lr = keeps_lr, .lambda_hr = float(lambda_hr), .scale = float(scale)};
  if (!colour.is_none()) {
    auto t = nb::cast<nb::dict>(colour);
    m.bases = nb::cast<int>(t["bases"]);
    if (m.bases < 1 || m.bases > kLanes) throw nb::value_error("the basis must have 1 to 16 columns");
    m.basis = tensors.rows<const float>(t, "basis", n, m.bases), m.colour = tensors.rows<const float>(t, "rgb", n, 3);
  }
  if (attributes.size() > kGroups + 1) throw nb::value_error("there are at most seven attributes");
  for (nb::handle item : attributes) {
    auto t = nb::cast<nb::dict>(item);
    int width = nb::cast<int>(t["width"]), group = nb::cast<int>(t["group"]), first_band = nb::cast<int>(t["first_band"]);
    if (width < 0 || width > kWidest) throw nb::value_error("an attribute must have 0 to 45 numbers a row");
    if (group < 0 || group > kGroups) throw nb::value_error("a group must be 0 to 6");
    if (first_band == 0 && width != 3) throw nb::value_error("the constant band must have 3 numbers a row");
    auto read = [&](const char* name) { return tensors.rows<const float>(t, name, n, width, true); };
    m.attributes.push_back({read("lr"), read("before"), read("hr"), first_band, read("p"), read("anchor"),
                            float(nb::cast<double>(t["stiffness"])), tensors.rows<float>(t, "out", n, width), width, group});
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
  m.def("merge", &merge_gradients, nb::arg("n"), nb::arg("attributes"), nb::arg("colour").none(), nb::arg("correction").none(),
        nb::arg("keeps_lr"), nb::arg("lambda_hr"), nb::arg("scale"), nb::arg("threads"));
}

}  // namespace clear
