// Prints what the kernels compute, every bit of it, for test_toolchains.py to compare between processors. Those that need no Python.
#include <cstdio>
#include <vector>

#include "haar.hpp"
#include "photometric.hpp"
#include "reconcile.hpp"
#include "step.hpp"

using namespace clear;

namespace {

constexpr std::int64_t n = 1103;  // two tasks, and rows that fill no register
constexpr int bases = 4, width = 3 * (bases - 1), threads = 2;

// Uniform in [-1/2, 1/2) + shift, the same on every processor; every fifth is 0.
std::vector<float> numbers(std::size_t count, float size = 1, float shift = 0) {
  static std::uint64_t state = 1;
  std::vector<float> out(count);
  for (float& x : out) {
    state = state * 6364136223846793005ull + 1442695040888963407ull;
    x = (state >> 40) % 5 ? size * (float(state >> 40) / float(1 << 24) - 0.5f) + shift : shift;
  }
  return out;
}

template <class T>
void print(const char* name, const std::vector<T>& values) {
  std::printf("%s", name);
  for (T x : values) std::printf(" %a", double(x));
  std::printf("\n");
}

void print(const char* name, const Conflicts& found) {
  std::vector<double> counts(found.opposed, found.opposed + kGroups + 1);
  counts.insert(counts.end(), found.comparable, found.comparable + kGroups + 1);
  print(name, counts);
}

void losses() {
  constexpr int height = 67, row = 59 * kChannels;
  const std::vector<float> x = numbers(height * row, 1, 0.5f), y = numbers(height * row, 1, 0.5f);
  std::vector<float> gradient(height * row);
  const ImagePair images{x.data(), y.data(), gradient.data(), height, row};
  const PhotometricMeans means = photometric(images, {0.8f, 0.2f}, 0, threads);
  print("photometric", gradient);
  const double haar = haar_l1(images, 3, threads);
  print("haar", gradient);
  const PhotometricMeans inside = photometric({x.data(), y.data(), nullptr, height, row}, {0, 1}, ssim::kReach, threads);
  print("means", std::vector<double>{means.l1, means.dssim, haar, 1 - inside.dssim});
}

// Of a host: both gradients as rows, with one weight per Gaussian and group.
void reconciled(const Weights& weights, ProductTable products_of) {
  const std::vector<float> lr = numbers(3 * n), hr = numbers(3 * n), colours = numbers(3 * n), more = numbers(3 * n);
  const std::vector<float> basis = numbers(bases * n);
  std::vector<float> means(3 * n), shN(width * n);
  const TwoGradients g{n,
                       {{lr.data(), hr.data(), 3, kMeans, -1, nullptr, means.data()},
                        {nullptr, nullptr, width, kShN, 1, nullptr, shN.data()}},
                       {colours.data(), basis.data(), bases},
                       {more.data(), basis.data(), bases}};
  print("conflicts of rows", products(g, products_of, threads));
  apply(g, weights, 0.3f, true, threads);
  print("means of rows", means), print("shN of rows", shN);
}

struct Loss {
  std::vector<float> means = numbers(3 * n), quats = numbers(4 * n), scales = numbers(3 * n);
  std::vector<float> opacities = numbers(n), rgb = numbers(3 * n);
  SplatGradient rows() const { return {means.data(), quats.data(), scales.data(), opacities.data(), rgb.data()}; }
};

// Of this package's trainer: the chain rule of the activations, the merge, and Adam.
void stepped(const Weights& weights, ProductTable products_of) {
  const std::vector<float> scales = numbers(3 * n, 0.1f, 0.2f), filtered = numbers(3 * n, 0.1f, 0.3f), filter = numbers(n, 0.1f, 0.2f);
  const std::vector<float> sigmoid = numbers(n, 0.9f, 0.5f), factor = numbers(n, 0.5f, 0.7f);
  const std::vector<float> basis = numbers(bases * n), detail = numbers(3 * n);
  const Loss lr, hr;
  const Gradients g{n, bases, basis.data(), lr.rows(), hr.rows(), detail.data(),
                    {scales.data(), filtered.data(), filter.data(), sigmoid.data(), factor.data()}};
  print("conflicts of a step", products(g, products_of, threads));
  Step s;
  s.adam = {0.9f, 0.999f, 0.1f, 0.001f, 10.0f, 1e-15f};
  s.lambda_hr = 0.3f, s.width = width;
  std::vector<std::vector<float>> tensors;
  tensors.reserve(21);
  for (auto [attribute, columns] : {std::pair{&s.means, 3}, {&s.quats, 4}, {&s.scales, 3}, {&s.opacities, 1}, {&s.sh0, 3}, {&s.shN, width},
                                    {&s.detail, 3}}) {
    for (float** x : {&attribute->p, &attribute->m, &attribute->v}) tensors.push_back(numbers(columns * n)), *x = tensors.back().data();
    for (float& v : tensors.back()) v *= v;  // a second moment
    attribute->width = columns, attribute->rate = -0.01f;
  }
  print("rows at rest", std::vector<double>{double(step(g, weights, s, threads))});
  for (const auto& x : tensors) print("stepped", x);
}

}  // namespace

int main() {
  std::vector<double> rows(2 * kGroups * n), products_of(3 * kGroups * n);
  const std::vector<float> drawn = numbers(rows.size(), 1, 0.5f);
  rows.assign(drawn.begin(), drawn.end());
  const Weights weights{{0, rows.data(), n}, {0, rows.data() + kGroups * n, n}};
  losses();
  reconciled(weights, {products_of.data(), n});
  print("products of rows", products_of);
  stepped(weights, {products_of.data(), n});
  print("products of a step", products_of);
}
