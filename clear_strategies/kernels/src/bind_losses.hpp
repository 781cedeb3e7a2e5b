#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

namespace clear {

inline void bind_losses(nanobind::module_&) {}

}  // namespace clear
