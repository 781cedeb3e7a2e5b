// Mean absolute detail of the difference x - y in an orthonormal Haar basis, with its gradient.
//
// A level turns each block of pixels (a b; c d) into its low part (a+b+c+d)/2, the input of the next level, and three
// details: (a-b+c-d)/2, (a+b-c-d)/2, (a-b-c+d)/2. An odd last row or column is repeated; the repeated pixel receives the
// gradient of both. The backward pass needs only the signs of the details, from the last level to the first.
//
// Channels are interleaved: a number's partner lies three places after it (left pixel of a block) or before it (right
// pixel). Both compute the same details: half of the work is done twice, but no lanes are shuffled.
#pragma once

#include <array>
#include <cstring>
#include <vector>

#include "images.hpp"
#include "pool.hpp"
#include "simd.hpp"

namespace clear {
namespace haar {

using Floats = Lanes<float>;

inline constexpr int kRowPairsInATask = 8;

// The input of a level: x - y at the first level, the previous low part at the others.
struct Level {
  const float *x, *y;  // y is null except at the first level
  int height, width;   // pixels

  int low_height() const { return (height + 1) / 2; }
  int low_width() const { return (width + 1) / 2; }
  int even_row() const { return 2 * low_width() * kChannels; }  // numbers in a row that is padded to whole blocks
};

// Buffers for one row of blocks, padded on both sides for the partners of the first and last number.
class Workspace {
 public:
  explicit Workspace(const Level& level) : in_(level), width_((level.even_row() + kLanes - 1) / kLanes * kLanes) {
    std::size_t row = std::size_t(width_) + 2 * kLanes;
    memory_.assign(6 * row, 0.0f);
    for (int i = 0; i < 6; ++i) rows_[i] = memory_.data() + i * row + kLanes;
    for (int i = 0; i < width_; ++i) side()[i] = i / kChannels % 2 == 0 ? 1.0f : -1.0f;
  }

  int width() const { return width_; }     // rounded up to whole Lanes
  float* input(int k) { return rows_[k]; }  // k = 0 the upper row, 1 the lower
  float* output(int k) { return rows_[2 + k]; }
  float* above() { return rows_[4]; }  // the low part's gradient, repeated for each pixel of a block
  float* side() { return rows_[5]; }   // 1 for a block's left pixel, -1 for its right

  // The two rows of x and of y that a row of blocks is made of.
  std::array<const float*, 4> sources(int block_row) const {
    auto row = [&](const float* image, int r) {
      return image + std::ptrdiff_t(std::min(r, in_.height - 1)) * in_.width * kChannels;
    };
    const float *x = in_.x, *y = in_.y ? in_.y : x;
    return {row(x, 2 * block_row), row(x, 2 * block_row + 1), row(y, 2 * block_row), row(y, 2 * block_row + 1)};
  }

  void read(int block_row) {
    const auto rows = sources(block_row);
    const int n = in_.width * kChannels;
    for (int k : {0, 1}) {
      const float *x = rows[k], *y = rows[2 + k];
      float* to = input(k);
      for (int i = 0; i < n; ++i) to[i] = in_.y ? x[i] - y[i] : x[i];
      for (int i = n; i < in_.even_row(); ++i) to[i] = to[i - kChannels];
    }
  }

 private:
  Level in_;
  int width_;
  std::vector<float> memory_;
  float* rows_[6];
};

template <class Task>
void for_row_pairs(const Level& level, int threads, Task&& task) {
  int rows = level.low_height(), tasks = (rows + kRowPairsInATask - 1) / kRowPairsInATask;
  Pool::instance().run(threads, tasks, [&](std::int64_t i) {
    Workspace work(level);
    for (int j = int(i) * kRowPairsInATask; j < std::min(rows, int(i + 1) * kRowPairsInATask); ++j) task(work, j);
  });
}

inline void low_part(const Level& level, float* low, int threads) {
  for_row_pairs(level, threads, [&](Workspace& work, int j) {
    work.read(j);
    const float *upper = work.input(0), *lower = work.input(1);
    float* to = low + std::ptrdiff_t(j) * level.low_width() * kChannels;
    for (int i = 0; i < level.low_width(); ++i)
      for (int c = 0; c < kChannels; ++c) {
        int left = 2 * i * kChannels + c, right = left + kChannels;
        to[i * kChannels + c] = (upper[left] + upper[right] + lower[left] + lower[right]) * 0.5f;
      }
  });
}

// Gradient of one row of blocks, into work.output, or past the caches into the two rows from `stream_to` on; returns the sum of
// |detail| over it. Waiting for memory takes longer than the arithmetic, so the next row of blocks is fetched meanwhile.
inline double blocks_of_row(Workspace& work, int j, float scale, bool has_above, float* stream_to) {
  const float *upper = work.input(0), *lower = work.input(1);
  const auto next = work.sources(j + 1);
  Floats zero(0.0f), half(0.5f), plus(scale), sum(0.0f);
  auto signed_scale = [&](const Floats& v) { return where(v > zero, plus) - where(v < zero, plus); };
  for (int i = 0; i < work.width(); i += kLanes) {
    for (const float* row : next) __builtin_prefetch(row + i, 0, 2);
    Floats side = Floats::load(work.side() + i), up = Floats::load(upper + i), down = Floats::load(lower + i);
    auto left = side > zero;
    Floats a = select(left, up, Floats::load(upper + i - kChannels));
    Floats b = select(left, Floats::load(upper + i + kChannels), up);
    Floats c = select(left, down, Floats::load(lower + i - kChannels));
    Floats d = select(left, Floats::load(lower + i + kChannels), down);
    Floats horizontal = a - b + c - d, vertical = a + b - c - d, diagonal = a - b - c + d;
    sum += absolute(horizontal) + absolute(vertical) + absolute(diagonal);
    Floats h = side * signed_scale(horizontal), v = signed_scale(vertical), hv = side * signed_scale(diagonal);
    Floats low = has_above ? Floats::load(work.above() + i) : zero;
    Floats first = (low + h + v + hv) * half, second = (low + h - v - hv) * half;
    if (stream_to) first.stream(stream_to + i), second.stream(stream_to + work.width() + i);
    else first.store(work.output(0) + i), second.store(work.output(1) + i);
  }
  float lanes[kLanes];
  sum.store(lanes);
  double all = 0;
  for (float v : lanes) all += v;
  return all / 4;  // each detail was counted twice and not halved
}

// Writes the gradient of scale · Σ |detail| + <above, low part>; returns Σ |detail|.
inline double details(const Level& level, const float* above, float scale, float* gradient, int threads) {
  std::vector<double> sums(level.low_height());
  const int n = level.width * kChannels, low_width = level.low_width();
  for_row_pairs(level, threads, [&](Workspace& work, int j) {
    work.read(j);
    if (above) {
      const float* from = above + std::ptrdiff_t(j) * low_width * kChannels;
      float* to = work.above();
      for (int i = 0; i < low_width; ++i)
        for (int c = 0; c < kChannels; ++c)
          to[2 * i * kChannels + c] = to[(2 * i + 1) * kChannels + c] = from[i * kChannels + c];
    }
    float* to = gradient + std::ptrdiff_t(2 * j) * n;
    const bool aligned = n % kLanes == 0 && reinterpret_cast<std::uintptr_t>(gradient) % (kLanes * sizeof(float)) == 0;
    const bool stream = aligned && n == level.even_row() && 2 * j + 1 < level.height;
    sums[j] = blocks_of_row(work, j, scale, above != nullptr, stream ? to : nullptr);
    if (stream) return end_of_stream();
    float *upper = work.output(0), *lower = work.output(1);
    if (2 * j + 1 == level.height)
      for (int i = 0; i < work.width(); ++i) upper[i] += lower[i];
    for (float* row : {upper, lower})
      for (int i = n; i < level.even_row(); ++i) row[i - kChannels] += row[i];
    std::memcpy(to, upper, sizeof(float) * std::size_t(n));
    if (2 * j + 1 < level.height) std::memcpy(to + n, lower, sizeof(float) * std::size_t(n));
  });
  double all = 0;
  for (double v : sums) all += v;
  return all;
}

}  // namespace haar

// Mean |detail| of each level, averaged over the levels; writes its gradient with respect to x.
inline double haar_l1(const ImagePair& im, int levels, int threads) {
  using haar::Level;
  auto numbers = [](const Level& l) { return std::size_t(l.low_height()) * l.low_width() * kChannels; };
  std::vector<Level> pyramid{{im.x, im.y, im.height, im.row / kChannels}};
  std::vector<std::vector<float>> lows, gradients;
  for (int l = 1; l < levels; ++l) {
    const Level& finer = pyramid.back();
    lows.emplace_back(numbers(finer));
    gradients.emplace_back(numbers(finer));
    haar::low_part(finer, lows.back().data(), threads);
    pyramid.push_back({lows.back().data(), nullptr, finer.low_height(), finer.low_width()});
  }
  double value = 0;
  for (int l = levels - 1; l >= 0; --l) {
    double n = 3.0 * double(numbers(pyramid[l]));
    const float* above = l + 1 < levels ? gradients[l].data() : nullptr;
    float* gradient = l > 0 ? gradients[l - 1].data() : im.gradient;
    value += haar::details(pyramid[l], above, float(1 / (n * levels)), gradient, threads) / n;
  }
  return value / levels;
}

}  // namespace clear
