// Python bindings: `Frame`, in float32 or in float64. Checks shapes and types and releases the GIL; no arithmetic.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <memory>

#include "frame.hpp"
#include "isa.hpp"
#include "tensor.hpp"

namespace nb = nanobind;

namespace clear {

template <class T, std::int64_t... shape>
using Read = Tensor<const T, nb::shape<shape...>, nb::c_contig, nb::device::cpu>;
template <class T, std::int64_t... shape>
using Write = Tensor<T, nb::shape<shape...>, nb::c_contig, nb::device::cpu>;
template <class T>
using Rows = Tensor<const T, nb::shape<-1, -1, 3>, nb::device::cpu>;  // shN: rows need not be contiguous to each other

inline void require(bool holds, const char* rule) {
  if (!holds) throw nb::value_error(rule);
}

template <class T>
Splats<T> splats_of(const Read<T, -1, 3>& means, const Read<T, -1, 4>& quats, const Read<T, -1, 3>& scales,
                    const Read<T, -1, 1, 3>& sh0, const Rows<T>& shN) {
  const std::int64_t n = std::int64_t(means.shape(0)), bands = std::int64_t(shN.shape(1));
  require(std::int64_t(quats.shape(0)) == n && std::int64_t(scales.shape(0)) == n && std::int64_t(sh0.shape(0)) == n &&
              std::int64_t(shN.shape(0)) == n,
          "every tensor of the splats must have one row per Gaussian");
  require(n < std::int64_t(UINT32_MAX), "at most 2^32 - 2 Gaussians");
  require(bands == 0 || bands == 3 || bands == 8 || bands == 15, "shN must hold 0, 3, 8 or 15 bands");
  require(n == 0 || bands == 0 || (shN.stride(2) == 1 && shN.stride(1) == 3), "each row of shN must be contiguous");
  return {n, means.data(), quats.data(), scales.data(), sh0.data(), shN.data(), n ? shN.stride(0) : 0, int(bands)};
}

// The DLPack capsule of a tensor whose memory returns to the recycler when it is freed, for the gradients of the next iteration.
template <class T>
nb::ndarray<T> empty(const std::vector<std::size_t>& shape) {
  std::size_t size = 1;
  for (std::size_t edge : shape) size *= edge;
  auto buffer = std::make_unique<Buffer<T>>();
  buffer->reserve_lost(std::max<std::size_t>(size, 1));
  T* data = buffer->data();
  nb::capsule owner(buffer.get(), [](void* p) noexcept { delete static_cast<Buffer<T>*>(p); });
  buffer.release();
  return nb::ndarray<T>(data, shape.size(), shape.data(), owner);
}

template <class T>
void bind_frame(nb::module_& m) {
  using F = Frame<T>;
  nb::class_<F>(m, "Frame")
      .def(
          "__init__",
          [](F* self, double kernel, double near, double alpha_min, double alpha_max, double transmittance_min,
             std::vector<double> background, bool antialiased, std::vector<double> world_to_camera, std::int64_t budget) {
            require(background.size() == 3 && world_to_camera.size() == 16, "background and world_to_camera must have 3 and 16 numbers");
            // A pixel always ends before T becomes subnormal, because the backward pass could not rebuild it.
            const T through_min = std::max(T(transmittance_min), T(sizeof(T) == 4 ? 1e-30 : 1e-250));
            Settings<T> s{T(kernel), T(near), T(alpha_min), T(alpha_max), through_min,
                          {T(background[0]), T(background[1]), T(background[2])}, antialiased};
            Pose pose;
            for (int i = 0; i < 3; ++i) {
              for (int k = 0; k < 3; ++k) pose.R[3 * i + k] = world_to_camera[4 * i + k];
              pose.t[i] = world_to_camera[4 * i + 3];
            }
            for (int i = 0; i < 3; ++i)
              pose.center[i] = -(pose.R[i] * pose.t[0] + pose.R[3 + i] * pose.t[1] + pose.R[6 + i] * pose.t[2]);
            new (self) F(s, pose, budget);
          },
          nb::kw_only(), nb::arg("kernel"), nb::arg("near"), nb::arg("alpha_min"), nb::arg("alpha_max"),
          nb::arg("transmittance_min"), nb::arg("background"), nb::arg("antialiased"), nb::arg("world_to_camera"),
          nb::arg("budget"))
      .def("project",
           [](F& self, Read<T, -1, 3> means, Read<T, -1, 4> quats, Read<T, -1, 3> scales, Read<T, -1, 1, 3> sh0,
              Rows<T> shN, std::vector<std::vector<double>> grids, std::vector<Read<T, -1>> opacities,
              std::vector<std::optional<Read<T, -1, 3>>> offsets, std::vector<Write<T, -1, 2>> means2d,
              std::vector<Write<bool, -1>> visible, int threads) {
             Splats<T> splats = splats_of<T>(means, quats, scales, sh0, shN);
             const std::size_t n = std::size_t(splats.n), count = grids.size();
             require(count >= 1 && count <= 4 && opacities.size() == count && offsets.size() == count &&
                         means2d.size() == count && visible.size() == count,
                     "one to four pixel grids, each with its opacities, offset and outputs");
             std::vector<Target<T>> targets(count);
             for (std::size_t i = 0; i < count; ++i) {
               const std::vector<double>& g = grids[i];
               require(g.size() == 6, "a pixel grid is (fx, fy, cx, cy, width, height)");
               require(opacities[i].shape(0) == n && means2d[i].shape(0) == n && visible[i].shape(0) == n &&
                           (!offsets[i] || offsets[i]->shape(0) == n),
                       "every tensor of a pixel grid must have one row per Gaussian");
               targets[i].grid = {g[0], g[1], g[2], g[3], int(g[4]), int(g[5])};
               targets[i].opacities = opacities[i].data();
               targets[i].rgb_offset = offsets[i] ? offsets[i]->data() : nullptr;
               targets[i].means2d = means2d[i].data();
               targets[i].visible = visible[i].data();
             }
             nb::gil_scoped_release release;
             return self.project(splats, std::move(targets), threads);
           })
      .def_static("empty", &empty<T>, nb::rv_policy::reference)
      .def_static("release", [] { Recycler::instance().release(); })
      .def("pairs", &F::pairs)
      .def("draw",
           [](F& self, int i, Write<T, -1, -1, 3> image, Write<T, -1, -1> alpha, std::optional<Write<T, -1, -1>> depth,
              int threads) {
             T *pixels = image.data(), *cover = alpha.data(), *expected = depth ? depth->data() : nullptr;
             nb::gil_scoped_release release;
             self.draw(i, pixels, cover, expected, threads);
           },
           nb::arg("grid"), nb::arg("image"), nb::arg("alpha"), nb::arg("depth").none(), nb::arg("threads"))
      .def("radii",
           [](const F& self, int i, Write<std::int32_t, -1, 2> out, int threads) {
             std::int32_t* radii = out.data();
             nb::gil_scoped_release release;
             self.radii(i, radii, threads);
           })
      .def("shears",
           [](const F& self, int i, Write<T, -1, 3> out, int threads) {
             T* shears = out.data();
             nb::gil_scoped_release release;
             self.shears(i, shears, threads);
           })
      .def("vjp",
           [](F& self, int i, Read<T, -1, -1, -1, 3> image, std::optional<Read<T, -1, -1, -1>> alpha,
              std::optional<Read<T, -1, -1, -1>> depth, Write<T, -1, -1, 3> d_means,
              Write<T, -1, -1, 4> d_quats, Write<T, -1, -1, 3> d_scales, Write<T, -1, -1> d_opacities,
              Write<T, -1, -1, 2> d_screen, Write<T, -1, -1, 3> d_rgb, std::optional<Write<T, -1, -1, 2>> d_absgrad,
              std::optional<Read<T, -1>> weight, int threads) {
             const int K = int(image.shape(0));
             require(!weight || (std::int64_t(weight->shape(0)) == self.size() && K > 1 && K <= F::kMostCotangents && !depth && !d_absgrad),
                     "`weight` has one number per Gaussian, and sums two or three cotangents of an image without depth");
             Gradients<T> out{d_means.data(), d_quats.data(), d_scales.data(), d_opacities.data(), d_screen.data(), d_rgb.data(),
                              d_absgrad ? d_absgrad->data() : nullptr, weight ? weight->data() : nullptr};
             const Cotangents<T> v{image.data(), alpha ? alpha->data() : nullptr, depth ? depth->data() : nullptr};
             nb::gil_scoped_release release;
             self.vjp(i, K, v, out, threads);
           },
           nb::arg("grid"), nb::arg("image"), nb::arg("alpha").none(), nb::arg("depth").none(), nb::arg("d_means"), nb::arg("d_quats"),
           nb::arg("d_scales"), nb::arg("d_opacities"), nb::arg("d_screen"), nb::arg("d_rgb"), nb::arg("d_absgrad").none(),
           nb::arg("weight").none(), nb::arg("threads"))
      .def("basis",
           [](F& self, Write<T, -1, -1> out, int threads) {
             T* y = out.data();
             require(reinterpret_cast<std::uintptr_t>(y) % (kLanes * sizeof(T)) == 0, "`out` must come from `empty`");
             nb::gil_scoped_release release;
             self.basis(y, threads);
           });
}

}  // namespace clear

NB_MODULE(CLEAR_MODULE, m) {
  nanobind::set_leak_warnings(false);  // a script that ends while it holds a rendering has done nothing wrong
  m.attr("isa") = CLEAR_NAME;
  m.attr("sources") = CLEAR_SOURCES;
  m.def("instruction_sets", &clear::instruction_sets);
  nb::exception<clear::OverBudget>(m, "OverBudget", PyExc_MemoryError);
#if defined(CLEAR_DOUBLE)
  clear::bind_frame<double>(m);
#else
  clear::bind_frame<float>(m);
#endif
}
