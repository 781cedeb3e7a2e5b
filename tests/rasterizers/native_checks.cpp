// Checks of the kernels that need no Python, for processors that are emulated: lanes and rows against plain loops, and a
// frame in float32 against float64. Prints the first failure and returns 1. test_toolchains.py compiles and runs it.
#include <cmath>
#include <cstdio>
#include <memory>

#include "frame.hpp"

using namespace clear;

namespace {

int failures = 0;

void check(bool holds, const char* what, double value = 0) {
  if (holds) return;
  std::printf("%s: %g\n", what, value);
  ++failures;
}

// Uniform in [0, 1), the same on every processor.
struct Random {
  std::uint64_t state = 1;
  double operator()() {
    state = state * 6364136223846793005ull + 1442695040888963407ull;
    return double(state >> 11) / 9007199254740992.0;
  }
};

template <class T>
void check_lanes() {
  Random random;
  T a[kLanes], b[kLanes], c[kLanes];
  for (int i = 0; i < kLanes; ++i) a[i] = T(20 * random() - 10), b[i] = T(3 * random() + 0.1);
  const Lanes<T> x = Lanes<T>::load(a), y = Lanes<T>::load(b);
  const double tiny = sizeof(T) == 4 ? 3e-7 : 1e-13;
  auto close = [&](const Lanes<T>& found, auto&& exact, const char* what) {
    found.store(c);
    for (int i = 0; i < kLanes; ++i) check(std::abs(c[i] - exact(i)) <= tiny * (1 + std::abs(exact(i))), what, c[i]);
  };
  close(exp2(x), [&](int i) { return std::exp2(double(a[i])); }, "exp2");
  close(log2(y), [&](int i) { return std::log2(double(b[i])); }, "log2");
  close(root(y), [&](int i) { return std::sqrt(double(b[i])); }, "root");
  close(reciprocal(y), [&](int i) { return 1 / double(b[i]); }, "reciprocal");
  close(floor(x), [&](int i) { return std::floor(double(a[i])); }, "floor");
  close(minimum(x, y), [&](int i) { return double(std::min(a[i], b[i])); }, "minimum");
  close(select(x < y, x, y), [&](int i) { return double(a[i] < b[i] ? a[i] : b[i]); }, "select");
  for (std::uint32_t bits : {0u, 1u, 0xa5c3u, 0xffffu}) check(Mask<T>::from_bits(bits).bits() == bits, "mask", bits);
}

template <int D, class T>
void check_rows() {
  T rows[D * kLanes], back[D * kLanes], column[kLanes];
  for (int i = 0; i < D * kLanes; ++i) rows[i] = T(i + 1);
  Lanes<T> columns[D];
  split_rows(rows, columns);
  for (int d = 0; d < D; ++d) {
    columns[d].store(column);
    for (int i = 0; i < kLanes; ++i) check(column[i] == rows[D * i + d], "split_rows", D);
  }
  join_rows(back, columns);
  for (int i = 0; i < D * kLanes; ++i) check(back[i] == rows[i], "join_rows", D);
}

template <class T>
void check_transpose() {
  T numbers[kLanes][kLanes], row[kLanes];
  Lanes<T> lanes[kLanes];
  for (int i = 0; i < kLanes; ++i) {
    for (int j = 0; j < kLanes; ++j) numbers[i][j] = T(kLanes * i + j);
    lanes[i] = Lanes<T>::load(numbers[i]);
  }
  transpose(lanes);
  for (int i = 0; i < kLanes; ++i) {
    lanes[i].store(row);
    for (int j = 0; j < kLanes; ++j) check(row[j] == numbers[j][i], "transpose", i);
  }
}

void check_pick() {
  std::int32_t indices[kLanes];
  float table[kLanes], found[kLanes];
  for (int i = 0; i < kLanes; ++i) indices[i] = (5 * i + 3) % kLanes, table[i] = float(i * i);
  pick(Lanes<float>::load(table), indices).store(found);
  for (int i = 0; i < kLanes; ++i) check(found[i] == table[indices[i]], "pick", i);
}

// An image with its depth, and the gradients of two cotangents.
template <class T>
std::vector<double> drawn(int threads) {
  constexpr int n = 1003, width = 97, height = 66, bands = 15, K = 2;
  Random random;
  auto filled = [&](int count, auto&& value) {
    std::vector<T> out(count);
    for (T& x : out) x = T(float(value()));  // the same numbers in both precisions
    return out;
  };
  auto spread = [&](double size) { return [&random, size] { return size * (random() - 0.5); }; };
  std::vector<T> means = filled(3 * n, spread(2)), quats = filled(4 * n, spread(2)), sh0 = filled(3 * n, spread(2));
  std::vector<T> scales = filled(3 * n, [&] { return 0.01 + 0.06 * random(); }), shN = filled(3 * bands * n, spread(0.4));
  std::vector<T> opacities = filled(n, [&] { return 0.05 + 0.9 * random(); }), offset = filled(3 * n, spread(0.2));
  std::vector<T> cotangents = filled(K * width * height * kColour, spread(2));
  for (int i = 0; i < n; ++i) means[3 * i + 2] += T(3);

  const Settings<T> settings{T(0.3), T(0.01), T(1e-6), T(0.999), T(1e-9), {T(0.2), T(0.4), T(0.6)}, true};
  const Pose pose{{1, 0, 0, 0, 1, 0, 0, 0, 1}, {0, 0, 0}, {0, 0, 0}};
  const Splats<T> splats{n, means.data(), quats.data(), scales.data(), sh0.data(), shN.data(), 3 * bands, bands};
  std::vector<T> means2d(2 * n), image(width * height * 3), alpha(width * height), depth(width * height);
  const std::unique_ptr<bool[]> visible(new bool[n]);
  std::vector<Target<T>> targets(1);
  targets[0].grid = {90, 90, 48, 33, width, height};
  targets[0].opacities = opacities.data(), targets[0].rgb_offset = offset.data();
  targets[0].means2d = means2d.data(), targets[0].visible = visible.get();

  Frame<T> frame(settings, pose, std::int64_t(1) << 30);
  check(frame.project(splats, std::move(targets), threads), "finite");
  frame.draw(0, image.data(), alpha.data(), depth.data(), threads);
  std::vector<T> d_means(K * 3 * n), d_quats(K * 4 * n), d_scales(K * 3 * n), d_opacities(K * n), d_screen(K * 2 * n), d_rgb(K * 3 * n);
  const Gradients<T> out{d_means.data(), d_quats.data(), d_scales.data(), d_opacities.data(), d_screen.data(), d_rgb.data(), nullptr};
  const T* v = cotangents.data();
  frame.vjp(0, K, {v, nullptr, nullptr}, out, threads);
  frame.vjp(0, 1, {v, v, v + width * height}, out, threads);  // the first again, with those of alpha and of depth
  std::vector<double> all;
  for (const std::vector<T>* part : {&image, &alpha, &depth, &d_means, &d_quats, &d_scales, &d_opacities, &d_screen, &d_rgb})
    all.insert(all.end(), part->begin(), part->end());
  return all;
}

// A field that grows asks for more each time: what it has outgrown is not kept beside the blocks that took its place.
void check_recycler() {
  Recycler& recycler = Recycler::instance();
  const std::size_t before = recycler.held();
  std::size_t bytes = 100'000;
  for (int i = 0; i < 12; ++i, bytes += bytes / 4) {
    const Recycler::Block a = recycler.take(bytes), b = recycler.take(bytes);
    check(a.bytes >= bytes && a.data != b.data, "block", double(a.bytes));
    recycler.give(a), recycler.give(b);
  }
  check(recycler.held() - before <= 4 * bytes, "blocks that were outgrown are kept", double(recycler.held() - before));
}

}  // namespace

int main() {
  check_recycler();
  check_lanes<float>(), check_lanes<double>();
  check_transpose<float>(), check_transpose<double>();
  check_rows<1, float>(), check_rows<2, float>(), check_rows<3, float>(), check_rows<4, float>();
  check_rows<2, double>(), check_rows<3, double>();
  check_pick();

  const std::vector<double> exact = drawn<double>(1), found = drawn<float>(1);
  double error = 0, size = 0;
  for (std::size_t i = 0; i < exact.size(); ++i) error += std::pow(found[i] - exact[i], 2), size += exact[i] * exact[i];
  check(std::sqrt(error / size) < 5e-5, "float32 against float64", std::sqrt(error / size));
  check(drawn<float>(3) == found, "bits over threads");
  if (!failures) std::printf("ok, float32 against float64: %.2g\n", std::sqrt(error / size));
  return failures != 0;
}
