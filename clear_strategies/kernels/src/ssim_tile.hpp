// A tile of an image: L1 and SSIM of its numbers, and their gradient.
//
// Channels are interleaved, so a neighbour along a row is three numbers away. Rows are kept in segments, and so windows down
// a column and along a row are summed by the same functions. A tile processes a group of rows at a time, and keeps the last
// rows of its images and maps in ring buffers that fit the L2 cache.
#pragma once

#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

#include "images.hpp"
#include "segments.hpp"
#include "ssim.hpp"

namespace clear {

// The loss: l1 · mean |x - y| + dssim · (1 - SSIM).
struct PhotometricWeights {
  float l1, dssim;
};

struct PhotometricMeans {
  double l1, dssim;  // mean |x - y|, 1 - SSIM
};

namespace ssim {

// Windows that are computed together, down and along.
inline constexpr int kDown = 4, kAlong = 4;

// The largest tile, in rows, and in numbers of a row with those that its windows reach beside it: larger buffers miss the L2
// cache more often. Where such tiles would be few, threads share lower ones.
inline constexpr int kTileHeight = 192, kLowTileHeight = 96, kTileWidth = 1536;
inline constexpr int kMargin = 2 * kReach * kChannels;  // the gradient reaches the maps, and these the images

// Rows, by what they hold of each number.
template <int Quantities>
using Row = Segments<Quantities, kReach * kChannels>;
using Images = Row<2>;         // y, e
using ColumnMoments = Row<4>;  // `Moments` of the windows down a column
using Maps = Row<5>;           // μy, μe, a, b, c
using ColumnSums = Row<3>;     // `Sums` of the windows down a column
using Single = Row<1>;

// The last rows of a tile's images or maps.
template <class Kind>
struct Ring {
  static constexpr int kRows = span(kDown);
  float* rows[kRows];
  float* operator[](int r) const { return rows[(r + 4 * kRows) % kRows]; }
};

// What the windows of kDown neighbouring rows cover of a quantity; `first` is the first row.
template <class Kind>
struct Down {
  const float* rows[span(kDown)];
  Down(const Ring<Kind>& ring, int first) {
    for (int k = 0; k < span(kDown); ++k) rows[k] = ring[first + k];
  }
  CLEAR_INLINE auto operator()(int quantity, std::ptrdiff_t place) const {
    return [this, place = place + quantity * kLanes](int k) CLEAR_LAMBDA { return load(rows[k] + place); };
  }
};

// What the windows of kAlong neighbouring pixels cover of a quantity of a row; `place` is the first pixel's.
template <class Kind>
struct Along {
  static constexpr std::ptrdiff_t kPixel = std::ptrdiff_t(kChannels) * Kind::kStep;
  const float* row;
  CLEAR_INLINE auto operator()(int quantity, std::ptrdiff_t place) const {
    return [p = row + place + quantity * kLanes - kReach * kPixel](int k) CLEAR_LAMBDA { return load(p + k * kPixel); };
  }
};

struct Tile {
  int top, bottom, left, right;  // rows and numbers of a row, ends excluded
};

inline int tiles_across(int row) {
  constexpr int most = kTileWidth - 2 * kMargin;
  return row <= kTileWidth ? 1 : (row + most - 1) / most;
}

// A thread's buffers, kept between calls because fresh memory costs a page fault every 4 KB. Whole vectors of them lie in
// whole cache lines.
inline float* scratch(std::size_t n) {
  static thread_local std::vector<float> memory;
  if (memory.size() < n + kLanes) memory.resize(n + kLanes);
  const auto address = reinterpret_cast<std::uintptr_t>(memory.data());
  return memory.data() + (-address % (kLanes * sizeof(float))) / sizeof(float);
}

// A tile at work. SSIM is that of the windows about pixels at least `inset` from the border.
class TileRun {
 public:
  TileRun(const ImagePair& images, const Tile& tile, PhotometricWeights weights, int inset = 0)
      : im_(images), tile_(tile), inset_(inset), left_(std::max(0, tile.left - kMargin)), length_(segment_length(images, tile)) {
    const auto share = [&](int inset) { return 1.0f / (float(im_.height - 2 * inset) * float(im_.row - 2 * inset * kChannels)); };
    l1_scale_ = weights.l1 * share(0), ssim_scale_ = -weights.dssim * share(inset);
    const std::size_t ring = Images::floats(length_) + Maps::floats(length_);
    const std::size_t group = ColumnMoments::floats(length_) + ColumnSums::floats(length_);
    float* free = scratch(span(kDown) * ring + kDown * group + 3 * Single::floats(length_) + numbers());
    auto take = [&]<class Kind>(Kind) { return std::exchange(free, free + Kind::floats(length_)) + Kind::kFirst; };
    for (float*& row : images_.rows) row = take(Images());
    for (float*& row : maps_.rows) row = take(Maps());
    for (float*& row : moments_) row = take(ColumnMoments());
    for (float*& row : sums_) row = take(ColumnSums());
    inside_ = take(Single()), mine_ = take(Single()), gradient_ = take(Single());
    numbers_ = free;
    mark(inset * kChannels, im_.row - inset * kChannels, inside_), mark(tile.left, tile.right, mine_);
  }

  // Writes the tile's part of the gradient, if there is one; returns its part of the sums, without a gradient that of SSIM alone.
  PhotometricMeans run() {
    const int beyond = im_.gradient ? kReach : 0;  // rows of maps above and below the tile that the gradient needs
    int q = tile_.top + beyond;  // after the maps of this group, the gradient of the group five rows above has all its inputs
    while (q > tile_.top - beyond) q -= kDown;
    for (int r = q - kReach; r < q + kReach; ++r) read(r);
    for (; q - beyond < tile_.bottom; q += kDown) {
      for (int r = 0; r < kDown; ++r) read(q + kReach + r);
      forward(q);
      if (im_.gradient && q - kReach >= tile_.top) backward(q - kReach);
    }
    return totals_;
  }

 private:
  static int segment_length(const ImagePair& im, const Tile& t) {
    const int numbers = std::min(im.row, t.right + kMargin) - std::max(0, t.left - kMargin);
    constexpr int whole = kAlong * kChannels, least = (kLanes + whole - 1) / whole * whole;
    return std::max(least, (numbers + kLanes * whole - 1) / (kLanes * whole) * whole);
  }

  int numbers() const { return length_ * kLanes; }

  // Visits the registers of a row's vectors [from, to): their vector, and the register's lane in it.
  template <class Visit>
  static CLEAR_INLINE void each_register(int from, int to, Visit&& visit) {
    for (int v = from; v < to; ++v)
      for (int lane = 0; lane < kLanes; lane += kWidth) visit(v, lane);
  }

  // The same of a whole row where kAlong neighbouring pixels are computed together: those of the first one.
  template <class Visit>
  CLEAR_INLINE void each_group(Visit&& visit) const {
    for (int v = 0; v < length_; v += kAlong * kChannels) each_register(v, v + kChannels, visit);
  }

  template <class Kind>
  static CLEAR_INLINE std::ptrdiff_t place(int v, int lane) {
    return std::ptrdiff_t(v) * Kind::kStep + lane;
  }

  // 1 for the numbers [from, to) of the image's rows, 0 for the others.
  void mark(int from, int to, float* row) {
    for (int i = 0; i < numbers(); ++i) numbers_[i] = left_ + i >= from && left_ + i < to;
    Single::cut(numbers_, length_, 0, row);
  }

  // An image's row, or its last one, from the tile's left end on.
  template <class T>
  T* row_of(T* image, int r) const {
    return image + std::ptrdiff_t(std::min(r, im_.height - 1)) * im_.row + left_;
  }

  // The same with zeros beyond the image's right end.
  const float* padded(const float* row, float* copy) const {
    const int there = im_.row - left_;
    if (there >= numbers()) return row;
    std::copy_n(row, there, copy);
    std::fill(copy + there, copy + numbers(), 0.0f);
    return copy;
  }

  void read(int r) {
    float* to = images_[r];
    if (r < 0 || r >= im_.height) {
      std::fill_n(to, length_ * Images::kStep, 0.0f);
      return;
    }
    Images::cut(padded(row_of(im_.y, r), numbers_), length_, 0, to);
    Images::cut(padded(row_of(im_.x, r), numbers_), length_, 1, to);
    each_register(0, length_, [&](int v, int lane) CLEAR_LAMBDA {
      float* here = to + place<Images>(v, lane);
      store(here + kLanes, load(here) - load(here + kLanes));
    });
  }

  // The maps of the rows from q on; zero where windows do not count.
  void forward(int q) {
    const Down<Images> down(images_, q - kReach);
    const auto alone = [](int, const Register& v) CLEAR_LAMBDA { return v; };
    each_register(0, length_, [&](int v, int lane) CLEAR_LAMBDA {
      const std::ptrdiff_t from = place<Images>(v, lane), to = place<ColumnMoments>(v, lane);
      Moments m[kDown];
      moments<kDown>(down(0, from), down(1, from), alone, alone, m);
#pragma GCC unroll 16
      for (int r = 0; r < kDown; ++r) {
        float* here = moments_[r] + to;
        store(here, m[r].y), store(here + kLanes, m[r].e), store(here + 2 * kLanes, m[r].xy), store(here + 3 * kLanes, m[r].ee);
      }
    });
    for (int r = 0; r < kDown; ++r) {
      const int at = q + r;
      if (at < inset_ || at >= im_.height - inset_) {
        std::fill_n(maps_[at], length_ * Maps::kStep, 0.0f);
      } else {
        ColumnMoments::continue_ends(moments_[r], length_);
        const double dissimilarity = maps_of_row(moments_[r], at);
        if (at >= tile_.top && at < tile_.bottom) totals_.dssim += dissimilarity;
      }
    }
  }

  // Returns Σ (1 - SSIM) of the tile's numbers.
  double maps_of_row(const float* column_moments, int r) {
    float* maps = maps_[r];
    const float *next_x = row_of(im_.x, r + kReach + kDown), *next_y = row_of(im_.y, r + kReach + kDown);
    const Along<ColumnMoments> along{column_moments};
    Register sum{};
    each_group([&](int v, int lane) CLEAR_LAMBDA {
      const std::ptrdiff_t from = place<ColumnMoments>(v, lane);
      const auto xy = along(2, from), ee = along(3, from);
      Moments m[kAlong];
      moments<kAlong>(
          along(0, from), along(1, from), [&](int k, const Register& more) CLEAR_LAMBDA { return xy(k) + more; },
          [&](int k, const Register& more) CLEAR_LAMBDA { return ee(k) + more; }, m);
#pragma GCC unroll 16
      for (int p = 0; p < kAlong; ++p) {
        const std::ptrdiff_t at = place<Single>(v + p * kChannels, lane);
        const Coefficients k = coefficients(m[p], load(inside_ + at));
        float* to = maps + place<Maps>(v + p * kChannels, lane);
        store(to, m[p].y), store(to + kLanes, m[p].e);
        store(to + 2 * kLanes, k.a), store(to + 3 * kLanes, k.b), store(to + 4 * kLanes, k.c);
        sum += load(mine_ + at) * k.dissimilarity;
        __builtin_prefetch(next_x + at, 0, 2), __builtin_prefetch(next_y + at, 0, 2);
      }
    });
    return total(sum);
  }

  // The gradient of the rows from p on.
  void backward(int p) {
    const Down<Maps> down(maps_, p - kReach);
    float* middle = images_[std::min(p + kDown / 2, im_.height - 1)];
    each_register(0, length_, [&](int v, int lane) CLEAR_LAMBDA {
      const std::ptrdiff_t from = place<Maps>(v, lane), to = place<ColumnSums>(v, lane);
      const float* origin = middle + place<Images>(v, lane);
      Sums s[kDown];
      sums<kDown>(load(origin), load(origin + kLanes), down(0, from), down(1, from), down(2, from), down(3, from), down(4, from), s);
#pragma GCC unroll 16
      for (int r = 0; r < kDown; ++r) {
        float* here = sums_[r] + to;
        store(here, s[r].a), store(here + kLanes, s[r].b), store(here + 2 * kLanes, s[r].c);
      }
    });
    Images::continue_ends(middle, length_);
    for (int r = 0; r < kDown && p + r < tile_.bottom; ++r) {
      ColumnSums::continue_ends(sums_[r], length_);
      gradient_of_row(sums_[r], middle, p + r);
    }
  }

  void gradient_of_row(const float* column_sums, const float* middle, int r) {
    const Along<ColumnSums> along{column_sums};
    const Along<Images> origins{middle};
    const float *images = images_[r], *next = row_of(im_.gradient, r + kDown);
    const Register step = l1_scale_ - Register{}, zero{};
    Register sum{};
    each_group([&](int v, int lane) CLEAR_LAMBDA {
      const std::ptrdiff_t from = place<ColumnSums>(v, lane), at_origins = place<Images>(v, lane);
      const auto y_of = origins(0, at_origins), e_of = origins(1, at_origins);
      const Register y0 = y_of(span(kAlong) / 2), e0 = e_of(span(kAlong) / 2);
      Sums s[kAlong];
      sums<kAlong>(y0, e0, y_of, e_of, along(0, from), along(1, from), along(2, from), s);
#pragma GCC unroll 16
      for (int p = 0; p < kAlong; ++p) {
        const float* here = images + place<Images>(v + p * kChannels, lane);
        const std::ptrdiff_t at = place<Single>(v + p * kChannels, lane);
        const Register y = load(here), e = load(here + kLanes);
        const Register l1 = Native<float>::select(Native<float>::less(e, zero), step, zero) -
                            Native<float>::select(Native<float>::less(zero, e), step, zero);
        store(gradient_ + at, l1 + ssim_scale_ * (s[p].a + s[p].b * (y - y0) + s[p].c * (e - e0)));
        sum += load(mine_ + at) * Native<float>::maximum(e, -e);
        __builtin_prefetch(next + at, 1, 2);
      }
    });
    totals_.l1 += total(sum);
    Single::join(gradient_, length_, 0, numbers_);
    const int from = tile_.left - left_, to = tile_.right - left_;
    std::copy(numbers_ + from, numbers_ + to, row_of(im_.gradient, r) + from);
  }

  ImagePair im_;
  Tile tile_;
  int inset_;
  int left_, length_;  // the number of the image's rows that the tile's begin with; the length of their segments
  float l1_scale_, ssim_scale_;
  Ring<Images> images_;
  Ring<Maps> maps_;
  float *moments_[kDown], *sums_[kDown];  // of a group of rows
  float *inside_, *mine_, *gradient_, *numbers_;
  PhotometricMeans totals_{0, 0};
};

}  // namespace ssim
}  // namespace clear
