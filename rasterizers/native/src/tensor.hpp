// Tensors as arguments of bindings.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

namespace clear {

// As nb::ndarray, but never of a converted copy, which is freed when the call returns: a frame keeps pointers to tensors, and outputs
// are written to them. nanobind asks a torch tensor for its DLPack capsule by a method in Python, which takes 3 µs; an iteration passes
// 150 tensors, and torch's own function takes a fifteenth of it.
template <class... Args>
struct Tensor : nanobind::ndarray<Args...> {
  using nanobind::ndarray<Args...>::ndarray;
};

// The capsule of a torch tensor; null for anything else.
inline nanobind::object capsule_of(nanobind::handle tensor) {
  static PyObject* to_dlpack = nanobind::object(nanobind::module_::import_("torch.utils.dlpack").attr("to_dlpack")).release().ptr();
  PyObject* capsule = PyObject_CallOneArg(to_dlpack, tensor.ptr());
  if (!capsule) PyErr_Clear();
  return nanobind::steal(capsule);
}

}  // namespace clear

namespace nanobind::detail {

template <class... Args>
struct type_caster<clear::Tensor<Args...>> {
  NB_TYPE_CASTER(clear::Tensor<Args...>, make_caster<ndarray<Args...>>::Name)

  bool from_python(handle source, std::uint32_t flags, cleanup_list* cleanup) noexcept {
    flags &= ~std::uint32_t(cast_flags::convert);
    make_caster<ndarray<Args...>> array;
    object capsule = source.is_none() ? object() : clear::capsule_of(source);
    if (!array.from_python(capsule.is_valid() ? handle(capsule) : source, flags, cleanup)) return false;
    static_cast<ndarray<Args...>&>(value) = std::move(array.value);
    return true;
  }
};

}  // namespace nanobind::detail
