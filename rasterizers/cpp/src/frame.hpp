// A frame: one set of Gaussians seen from one pose on one or more pixel grids. Runs the stages and keeps what they share.
//
//   forward:   project -> order -> (for each band: list pairs -> blend)
//   backward:  (for each band: list pairs -> blend_vjp) -> project_vjp
//
// A band is some rows of bins, or a part of one. There is one, unless its pairs would not fit the memory budget; the image
// is then drawn band by band, with the same bits. What the backward pass needs is checked before the forward pass begins.
#pragma once

#include <stdexcept>
#include <string>

#include "order.hpp"
#include "passes.hpp"
#include "project_vjp.hpp"

namespace clear {

// The lists would need more memory than allowed; thrown before it is allocated.
struct OverBudget : std::runtime_error {
  using std::runtime_error::runtime_error;
};

template <class T>
class Frame {
 public:
  static constexpr int kMostCotangents = sizeof(T) == 4 ? 3 : 1;  // of one backward pass; in double, quick to compile instead

  Frame(const Settings<T>& settings, const Pose& pose, std::int64_t budget)
      : settings_(settings), pose_(pose), budget_(budget) {}

  // Returns false if a number that it read is not finite. Keeps pointers to the tensors.
  bool project(const Splats<T>& splats, std::vector<Target<T>> targets, int threads) {
    views_.clear();
    splats_ = splats;
    if (!clear::project(pose_, settings_, splats, targets, slopes_, depths_, drawn_, threads)) return false;
    order_by_depth<T>(drawn_, depths_, order_, threads);  // one for all grids
    for (Target<T>& target : targets) views_.push_back({std::move(target), {}, {}});
    return true;
  }

  std::int64_t size() const { return splats_.n; }
  std::int64_t pairs(int i) const { return views_.at(i).target.pairs; }

  // `depth` is null if it is not asked for.
  void draw(int i, T* image, T* alpha, T* depth, int threads) {
    View& view = views_.at(i);
    const Grid<T>& grid = view.target.grid;
    const std::size_t blocks = std::size_t(grid.columns()) * grid.rows() * kBlocks;
    view.ends.reserve_lost(blocks);
    bands_of(view, kBytesPerPair + sizeof(PairSums<T, kMostCotangents>));  // throws now where the gradients would not fit
    for (const Band& band : bands_of(view, kBytesPerPair)) {
      list(view, band, threads);
      Pool::instance().run(threads, band.bins(), [&](std::int64_t bin) {
        if (depth) draw_bin<T, kColourAndDepth>(job(view, bin), image, alpha, depth);
        else draw_bin<T, kColour>(job(view, bin), image, alpha, nullptr);
      });
      view.bins.has_masks = true;
    }
  }

  // The gradients [K, n, …] for K cotangents, of which `out.weight` allows two or three in float32.
  void vjp(int i, int K, const Cotangents<T>& v, const Gradients<T>& out, int threads) {
    View& view = views_.at(i);
    const std::int64_t pixels = std::int64_t(view.target.grid.width) * view.target.grid.height;
    for (int k = 0; k < K;) {
      const int now = v.depth || out.absgrad ? 1 : std::min(kMostCotangents, K - k);
      const std::int64_t at = k * splats_.n;
      Gradients<T> part{out.means + 3 * at,  out.quats + 4 * at, out.scales + 3 * at,
                        out.opacities + at,  out.screen + 2 * at, out.rgb + 3 * at,
                        out.absgrad ? out.absgrad + 2 * at : nullptr, out.weight};
      const Cotangents<T> these{v.image + k * pixels * kColour, v.alpha ? v.alpha + k * pixels : nullptr,
                                v.depth ? v.depth + k * pixels : nullptr};
      if (v.depth && out.absgrad) vjp_of<1, kColourAndDepth, true>(view, these, part, threads);
      else if (v.depth) vjp_of<1, kColourAndDepth>(view, these, part, threads);
      else if (out.absgrad) vjp_of<1, kColour, true>(view, these, part, threads);
      else if (now == 1) vjp_of<1>(view, these, part, threads);
      if constexpr (kMostCotangents > 1) {
        if (now == 2) vjp_of<2>(view, these, part, threads);
        if (now == 3) vjp_of<3>(view, these, part, threads);
      }
      k += now;
    }
  }

  // Half the box of every Gaussian that the grid draws, [n, 2], in whole pixels; zeros for the others. It reaches to where alpha falls
  // below alpha_min, at most 3.33 standard deviations, as gsplat's.
  void radii(int i, std::int32_t* out, int threads) const {
    each_ellipse<2>(i, out, threads, [&](const Ellipse<T>& e, std::int32_t* row) {
      const T power = std::max((e.peak - settings_.log2_alpha_min) * (2 / kLog2E<T>), T(0));
      const T reach = std::min(std::sqrt(power), T(3.33)) / std::sqrt(e.reach * (2 / kLog2E<T>));  // of `half`, which has a margin
      const T half[2] = {e.half_x * reach, e.half_y * reach};
      for (int c = 0; c < 2; ++c) row[c] = std::int32_t(std::ceil(std::clamp(half[c], T(1), T(1e9))));
    });
  }

  // (A, S, D) of every Gaussian that the grid draws, whose exponent is ½(A (dx + S dy)² + D dy²), [n, 3]; zeros for the others.
  void shears(int i, T* out, int threads) const {
    each_ellipse<3>(i, out, threads, [](const Ellipse<T>& e, T* row) {
      row[0] = e.A * (2 / kLog2E<T>), row[1] = e.S, row[2] = e.D * (2 / kLog2E<T>);
    });
  }

  // Y of every Gaussian that some grid draws, [n, bands + 1]; zeros for the others.
  void basis(T* out, int threads) {
    using L = Lanes<T>;
    const int width = splats_.bands + 1;
    auto write = [&](std::int64_t row, const L& Y) CLEAR_LAMBDA {
      T* to = out + row * width;
      if (width == kLanes) return Y.stream(to);
      T numbers[kLanes];
      Y.store(numbers);
      std::copy(numbers, numbers + width, to);
    };
    Pool::instance().run(threads, drawn_.chunks(), [&](std::int64_t chunk) {
      std::int64_t next = chunk * kChunk;
      auto zeros_until = [&](std::int64_t row) CLEAR_LAMBDA {
        for (; next < row; ++next) write(next, L(T(0)));
      };
      for (const std::uint32_t* number = drawn_.begin(chunk); number < drawn_.end(chunk); number += kLanes) {
        const Group group(number, drawn_.end(chunk) - number);
        L mean[3], direction[3], length, Y[kLanes];
        load_rows<3>(splats_.means, group, mean);
        direction_of(pose_, mean, direction, length);
        for (L& y : Y) y = T(0);
        each_band<T>(splats_.bands, direction,
                     [&](int k, const L& y, const auto&, const auto&, const auto&) CLEAR_LAMBDA { Y[k] = y; });
        transpose(Y);
        for (int i = 0; i < group.count; ++i) {
          zeros_until(group.rows[i]);
          write(next++, Y[i]);
        }
      }
      zeros_until(std::min(splats_.n, (chunk + 1) * kChunk));
      end_of_stream();
    });
  }

 private:
  // `Bins::pairs`, `where` and `masks`.
  static constexpr std::int64_t kBytesPerPair = 2 * sizeof(std::uint32_t) + sizeof(std::uint64_t);

  struct View {
    Target<T> target;
    Buffer<BlockEnd<T>> ends;           // [bins, 64]
    Bins bins;                          // the last listed band
  };

  // Calls `f(ellipse, row)` for every Gaussian that the grid draws; the rows of the others are zeros.
  template <int Width, class Number, class F>
  void each_ellipse(int i, Number* out, int threads, const F& f) const {
    const Target<T>& target = views_.at(i).target;
    Pool::instance().run(threads, drawn_.chunks(), [&](std::int64_t chunk) {
      const std::int64_t first = chunk * kChunk;
      std::fill(out + Width * first, out + Width * std::min(splats_.n, first + kChunk), Number(0));
      for (const std::uint32_t* number = drawn_.begin(chunk); number < drawn_.end(chunk); ++number)
        if (target.ranges[*number].count()) f(target.ellipses[*number], out + Width * std::int64_t(*number));
    });
  }

  // Splits the image into bands whose pairs fit the budget: rows of bins, and a row that does not fit into parts of it.
  std::vector<Band> bands_of(const View& view, std::int64_t bytes_per_pair) const {
    const std::int64_t most = std::min(budget_ / bytes_per_pair, std::int64_t(UINT32_MAX));
    const int columns = view.target.grid.columns(), rows = view.target.grid.rows();
    if (view.target.pairs <= most) return {whole(view.target.grid)};
    const std::vector<std::uint32_t> pairs = pairs_in_bins(view);
    std::vector<Band> bands;
    std::int64_t held = 0;
    for (int row = 0; row < rows; ++row)
      for (int first = 0, end = 0; first < columns; first = end) {
        const std::uint32_t* in_row = pairs.data() + std::size_t(row) * columns;
        std::int64_t here = 0;
        while (end < columns && here + in_row[end] <= most) here += in_row[end++];
        if (end == first) refuse(view, in_row[end], bytes_per_pair);
        const bool joins = end - first == columns && row && bands.back().columns() == columns && held + here <= most;
        if (joins) ++bands.back().y1, held += here;
        else bands.push_back({first, end, row, row + 1}), held = here;
      }
    return bands;
  }

  // The pairs of each bin of the image.
  std::vector<std::uint32_t> pairs_in_bins(const View& view) const {
    Coverage coverage(whole(view.target.grid));
    for (std::int64_t c = 0; c < drawn_.chunks(); ++c)
      for (const std::uint32_t* i = drawn_.begin(c); i < drawn_.end(c); ++i) coverage.add(view.target.ranges[*i]);
    std::vector<std::uint32_t> pairs(whole(view.target.grid).bins());
    coverage.each([&](int bin, std::uint32_t count) { pairs[bin] = count; });
    return pairs;
  }

  [[noreturn]] void refuse(const View& view, std::int64_t pairs, std::int64_t bytes_per_pair) const {
    std::int64_t largest = 0;
    for (std::int64_t i = 0; i < splats_.n; ++i)
      if (view.target.ranges[i].count() > view.target.ranges[largest].count()) largest = i;
    const Ellipse<T>& e = view.target.ellipses[largest];
    throw OverBudget("one bin of 32 px holds " + std::to_string(pairs) + " Gaussians, whose image and gradients need " +
                     std::to_string(((pairs * bytes_per_pair) >> 20) + 1) + " MiB, and `memory` allows " +
                     std::to_string(budget_ >> 20) + " MiB. The largest Gaussian is number " +
                     std::to_string(largest) + ", " + std::to_string(std::int64_t(std::min<T>(2 * e.half_x, T(1e9)))) +
                     " px wide. Raise `memory`, or remove Gaussians that large.");
  }

  static Band whole(const Grid<T>& grid) { return {0, grid.columns(), 0, grid.rows()}; }

  void list(View& view, const Band& band, int threads) {
    list_pairs(band, whole(view.target.grid), drawn_, order_, view.target.ranges, view.bins, threads);
  }

  // The job of a bin of the band.
  BinJob<T> job(View& view, std::int64_t bin) const {
    const Grid<T>& s = view.target.grid;
    const Band& band = view.bins.band;
    const int x = band.x0 + int(bin) % band.columns(), y = band.y0 + int(bin) / band.columns();
    const std::size_t place = std::size_t(y) * s.columns() + x;
    return {settings_, s, view.target.ellipses, view.bins, int(bin), x, y, blocks_in_image(x, y, s.width, s.height),
            view.ends.data() + place * kBlocks};
  }

  template <int K, int C = kColour, bool Absolute = false>
  void vjp_of(View& view, const Cotangents<T>& cotangents, const Gradients<T>& out, int threads) {
    using Sums = PairSums<T, K, C, Absolute>;
    const std::vector<Band> bands = bands_of(view, kBytesPerPair + sizeof(Sums));
    const bool whole = bands.size() == 1;
    Buffer<Sums> pair_sums, splat_sums;  // by pair; by Gaussian, when there are several bands
    if (!whole) {
      splat_sums.reserve_lost(splats_.n);
      std::memset(static_cast<void*>(splat_sums.data()), 0, sizeof(Sums) * splats_.n);
    }
    for (const Band& band : bands) {
      if (view.bins.band != band) list(view, band, threads);
      pair_sums.reserve_lost(view.bins.pairs.size());
      Pool::instance().run(threads, band.bins(),
                           [&](std::int64_t bin) { blend_vjp_bin<T, K, C, Absolute>(job(view, bin), cotangents, pair_sums.data()); });
      view.bins.has_masks = true;
      if (whole) break;
      Pool::instance().run(threads, chunks_of(splats_.n),
                           [&](std::int64_t chunk) { add_band(view, chunk, pair_sums.data(), splat_sums.data()); });
    }
    Pool::instance().run(threads, chunks_of(splats_.n), [&](std::int64_t chunk) {
      vjp_of_chunk<K, C, Absolute>(view, chunk, whole, (whole ? pair_sums : splat_sums).data(), out);
    });
  }

  // Adds the pair sums of the listed band to the sums of a chunk's Gaussians.
  template <class Sums>
  void add_band(const View& view, std::int64_t chunk, const Sums* pair_sums, Sums* splat_sums) {
    Lanes<T> rows[Sums::kRows][kLanes];
    for (const std::uint32_t* number = drawn_.begin(chunk); number < drawn_.end(chunk); number += kLanes) {
      const Group group(number, drawn_.end(chunk) - number);
      load_sums(group, splat_sums, rows);
      add_pair_sums(view.bins, group, pair_sums, rows);
      for (int r = 0; r < Sums::kRows; ++r)
        for (int i = 0; i < group.count; ++i) rows[r][i].store(splat_sums[group.rows[i]].numbers + r * kLanes);
    }
  }

  template <class Sums, int R>
  void load_sums(const Group& group, const Sums* splat_sums, Lanes<T> (&rows)[R][kLanes]) const {
    for (int r = 0; r < R; ++r)
      for (int i = 0; i < kLanes; ++i) rows[r][i] = Lanes<T>::load(splat_sums[group.rows[i]].numbers + r * kLanes);
  }

  // The gradients of a chunk's Gaussians from `sums`, by pair where one band is the whole image, else by Gaussian.
  template <int K, int C, bool Absolute>
  void vjp_of_chunk(const View& view, std::int64_t chunk, bool whole, const PairSums<T, K, C, Absolute>* sums,
                    const Gradients<T>& out) {
    using Sums = PairSums<T, K, C, Absolute>;
    constexpr std::int64_t ahead = 6 * kLanes;
    const std::int64_t first = chunk * kChunk, end = std::min(splats_.n, first + kChunk);
    auto touched = [&](std::int64_t i) {
      return whole ? view.bins.first[i + 1] > view.bins.first[i] : view.target.ranges[i].count() > 0;
    };
    std::uint32_t numbers[kChunk + ahead];
    std::int64_t count = 0;
    for (const std::uint32_t* i = drawn_.begin(chunk); i < drawn_.end(chunk); ++i) numbers[count] = *i, count += touched(*i);
    const bool sparse = count < (end - first) / 2;
    if (sparse) {
      clear_gradients<T, K>(splats_.n, first, end - first, out);
    } else {  // most of them: contiguous rows are read and written faster than scattered ones
      count = end - first;
      for (std::int64_t i = 0; i < kChunk + ahead; ++i) numbers[i] = std::uint32_t(std::min(first + i, splats_.n - 1));
    }
    const std::int64_t known = sparse ? count : count + ahead;
    for (std::int64_t at = 0; at < count; at += kLanes) {
      const Group group(numbers + at, count - at);
      Lanes<T> rows[Sums::kRows][kLanes];
      fetch_rows(splats_, view.target, slopes_, numbers + std::min(known, at + 2 * kLanes),
                 numbers + std::min(known, at + 3 * kLanes));
      if (whole) {
        fetch_pair_sums(view.bins, numbers + std::min(known, at + ahead), numbers + std::min(known, at + ahead + kLanes), sums);
        for (auto& row : rows)
          for (Lanes<T>& lanes : row) lanes = T(0);
        add_pair_sums(view.bins, group, sums, rows);
      } else {
        load_sums(group, sums, rows);
      }
      for (auto& row : rows) transpose(row);
      std::uint32_t bits = 0;
      for (int i = 0; i < group.count; ++i) bits |= std::uint32_t(sparse || touched(group.rows[i])) << i;
      project_vjp_group(pose_, settings_, splats_, view.target, slopes_, group, K, rows[0], bits, out);
      if constexpr (C == kColourAndDepth) depth_vjp_group(pose_, group, rows[0][Sums::of_channel(kColour)], bits, out.means);
    }
  }

  Settings<T> settings_;
  Pose pose_;
  std::int64_t budget_;
  Splats<T> splats_{};
  Drawn drawn_;
  Buffer<Slope<T>> slopes_;  // [n]
  Buffer<double> depths_;
  Buffer<std::uint32_t> order_;
  std::vector<View> views_;
};

}  // namespace clear
