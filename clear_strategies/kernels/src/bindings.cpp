// The Python module: image losses, the reconciliation of gradients, and the per-Gaussian step. The bindings check types and shapes and release the GIL.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "activate.hpp"
#include "bind_losses.hpp"
#include "bind_reconcile.hpp"
#include "bind_step.hpp"
#include "filter.hpp"
#include "isa.hpp"
#include "smooth.hpp"
#include "sweep.hpp"
#include "wander.hpp"

NB_MODULE(CLEAR_MODULE, m) {
  nanobind::set_leak_warnings(false);  // a script that ends while it holds a rendering has done nothing wrong
  m.attr("isa") = CLEAR_NAME;
  m.attr("sources") = CLEAR_SOURCES;
  m.def("instruction_sets", &clear::instruction_sets);
  clear::bind_activate(m);
  clear::bind_losses(m);
  clear::bind_reconcile(m);
  clear::bind_step(m);
  clear::bind_filter(m);
  clear::bind_sweep(m);
  clear::bind_smooth(m);
  clear::bind_wander(m);
}
