// Compiled with -ffp-contract=off: sums and products round as in torch.
#include "smooth.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

#include "block.hpp"

namespace clear {
namespace {

constexpr float kFar = 1e9f;    // cost of planes before the first and after the last
constexpr float kEdge = 20.0f;  // P2 is halved where neighbours differ by 1 / kEdge in grey

// L of a row of pixels, one path after the other. Around each pixel's planes lie far ones; around the row, pixels with L = 0.
class Rows {
 public:
  Rows(int paths, int width, int planes)
      : width_(width), planes_(planes), stride_((planes + 3 * kLanes) / kLanes * kLanes),
        values_(std::size_t(paths) * (width + 2) * stride_) {
    for (std::size_t at = 0; at < values_.size(); at += stride_) {
      values_[at] = kFar;
      std::fill(values_.begin() + std::ptrdiff_t(at) + 1 + planes, values_.begin() + std::ptrdiff_t(at) + stride_, kFar);
    }
  }
  // Its planes begin at 1; x from -1 to the width.
  float* at(int path, int x) { return values_.data() + (std::size_t(path) * (width_ + 2) + x + 1) * stride_; }
  // After planes were written sixteen at a time.
  void close(float* pixel) const { std::fill_n(pixel + 1 + planes_, kLanes, kFar); }

 private:
  int width_, planes_, stride_;
  std::vector<float> values_;
};

CLEAR_INLINE float lowest_of(const float* planes, int count) {
  Floats low = Floats::load(planes);
  for (int p = kLanes; p < count; p += kLanes) low = minimum(low, Floats::load(planes + p));
  float each[kLanes];
  low.store(each);
  return *std::min_element(each, each + kLanes);
}

// A step of a path from the pixel before it: L(p) = C(p) + min(L(q, d), L(q, d ± 1) + P1, min L(q) + P2) - min L(q).
CLEAR_INLINE void step(const float* before, const float* cost, int planes, float small_step, float jump, float* after, float* total) {
  const float least = lowest_of(before + 1, planes);
  const Floats lowest = least, limit = least + jump, one = small_step;
  for (int p = 0; p < planes; p += kLanes) {
    const int count = std::min(kLanes, planes - p);
    Floats best = minimum(Floats::load(before + p), Floats::load(before + p + 2)) + one;
    best = minimum(minimum(best, Floats::load(before + p + 1)), limit);
    best = (best - lowest) + load_some(cost + p, count);
    best.store(after + 1 + p);
    if (count == kLanes) {
      (Floats::load(total + p) + best).store(total + p);
    } else {
      for (int i = 0; i < count; ++i) total[p + i] += after[1 + p + i];
    }
  }
}

// The paths that come from the row before, `shifts` columns aside; turned: rows are the volume's columns.
void scan(const CostVolume& v, bool turned, bool backward, const std::vector<int>& shifts, float small_step, float large_step,
          float* total) {
  const int rows = turned ? v.width : v.height, columns = turned ? v.height : v.width, paths = int(shifts.size());
  auto pixel = [&](int row, int column) {
    const int along = backward ? rows - 1 - row : row;
    return turned ? std::size_t(column) * v.width + along : std::size_t(along) * v.width + column;
  };
  Rows before(paths, columns, v.planes), after(paths, columns, v.planes);
  for (int row = 0; row < rows; ++row) {
    for (int k = 0; k < paths; ++k)
      for (int x = 0; x < columns; ++x) {
        const std::size_t here = pixel(row, x), previous = pixel(std::max(row - 1, 0), std::clamp(x + shifts[k], 0, columns - 1));
        const float difference = std::fabs(v.grey[here] - v.grey[previous]);
        const float jump = std::max((1.0f / (1.0f + difference * kEdge)) * large_step, small_step);
        float* to = after.at(k, x);
        step(before.at(k, x + shifts[k]), v.cost + here * v.planes, v.planes, small_step, jump, to, total + here * v.planes);
        after.close(to);
      }
    std::swap(before, after);
  }
}

}  // namespace

void add_paths(const CostVolume& volume, float small_step, float large_step, float* total) {
  for (bool turned : {false, true})
    for (bool backward : {false, true})
      scan(volume, turned, backward, turned ? std::vector<int>{0} : std::vector<int>{-1, 0, 1}, small_step, large_step, total);
}

}  // namespace clear
