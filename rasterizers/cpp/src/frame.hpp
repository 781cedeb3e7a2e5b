// A frame: one set of Gaussians seen from one pose on one or more screens. Runs the stages and keeps what they share.
//
//   project -> order -> (for each band: list pairs -> blend)          and back: (list pairs -> blend_vjp) -> pull
//
// A band is some rows of bins. There is one, unless its pairs would not fit the memory budget; then the picture is drawn
// band by band, and bit for bit the same.
#pragma once

#include <optional>

#include "order.hpp"
#include "pull.hpp"

namespace clear {

// More memory than allowed, said before it is taken.
struct OverBudget : std::runtime_error {
  using std::runtime_error::runtime_error;
};

// Which tiles of `edge` px are asked for; edge is a multiple of 4.
struct Demand {
  const bool* tiles;
  int edge, columns;
};

template <class T>
class Frame {
 public:
  Frame(const Settings<T>& settings, const Pose<T>& pose, std::int64_t budget)
      : settings_(settings), pose_(pose), budget_(budget) {}

  // False if a number that was needed is not finite.
  bool project(const Splats<T>& splats, std::vector<Target<T>> targets, int threads) {
    views_.clear();
    n_ = splats.n;
    if (!clear::project(pose_, settings_, splats, targets, palette_, depths_, threads)) return false;
    // One order over the union of what any screen shows.
    order_by_depth<T>(
        n_,
        [&](std::int64_t i) {
          for (const Target<T>& t : targets)
            if (t.visible[i]) return true;
          return false;
        },
        [&](std::int64_t i) { return depths_[i]; }, order_, threads);
    for (Target<T>& target : targets) {
      View view;
      view.target = std::move(target);
      view.pairs_in_row = count_pairs(view.target.screen.rows(), view.target.ranges, n_, threads);
      views_.push_back(std::move(view));
    }
    return true;
  }

  std::int64_t pairs(int i) const {
    std::int64_t total = 0;
    for (std::int64_t p : views_.at(i).pairs_in_row) total += p;
    return total;
  }

  void draw(int i, T* image, T* alpha, const std::optional<Demand>& demand, int threads) {
    View& view = views_.at(i);
    const Screen<T>& screen = view.target.screen;
    ask_for(view, demand);
    view.ends.reserve_lost(std::size_t(screen.columns()) * screen.rows() * kBlocks);
    const std::vector<int> bands = bands_of(view, kBytesPerPair);
    for (std::size_t b = 0; b + 1 < bands.size(); ++b) {
      list(view, bands[b], bands[b + 1], threads);
      draw_band(view, image, alpha, threads);
    }
  }

  // K cotangents [K, height, width, 3] to gradients [K, n, …].
  void vjp(int i, int K, const T* cotangents, const Splats<T>& splats, const Gradients<T>& out, int threads) {
    View& view = views_.at(i);
    const std::int64_t image = std::int64_t(view.target.screen.width) * view.target.screen.height * 3;
    for (int k = 0; k < K;) {
      const int now = std::min(3, K - k);
      const std::int64_t at = k * n_;
      Gradients<T> part{out.means + 3 * at,     out.quats + 4 * at,  out.scales + 3 * at,
                        out.opacities + at, out.screen + 2 * at, out.rgb + 3 * at};
      if (now == 1) vjp_of<1>(view, cotangents + k * image, splats, part, threads);
      if (now == 2) vjp_of<2>(view, cotangents + k * image, splats, part, threads);
      if (now == 3) vjp_of<3>(view, cotangents + k * image, splats, part, threads);
      k += now;
    }
  }

  // Y of every Gaussian that some screen shows, [n, bands + 1]; zeros for the others.
  void basis(const Splats<T>& splats, T* out, int threads) {
    using L = Lanes<T>;
    const int width = splats.bands + 1;
    const std::int64_t groups = groups_of(n_), per_task = 64;
    Pool::instance().run(threads, (groups + per_task - 1) / per_task, [&](std::int64_t task) {
      for (std::int64_t g = task * per_task; g < std::min(groups, (task + 1) * per_task); ++g) {
        const std::int64_t first = g * kLanes;
        const int count = int(std::min<std::int64_t>(kLanes, n_ - first));
        L mean[3], direction[3], length, Y[kLanes];
        load_rows<3>(splats.means, first, count, mean);
        direction_of(pose_, mean, direction, length);
        for (L& y : Y) y = T(0);
        each_band<T>(splats.bands, direction,
                     [&](int k, const L& y, const L&, const L&, const L&) CLEAR_LAMBDA { Y[k] = y; });
        transpose(Y);
        T row[kLanes];
        for (int i = 0; i < count; ++i) {
          bool shows = false;
          for (const View& view : views_) shows |= view.target.visible[first + i];
          (shows ? Y[i] : L(T(0))).store(row);
          std::copy(row, row + width, out + (first + i) * width);
        }
      }
    });
  }

 private:
  // Gaussian, place, blocks.
  static constexpr std::int64_t kBytesPerPair = 2 * sizeof(std::uint32_t) + sizeof(std::uint64_t);

  struct View {
    Target<T> target;
    std::vector<std::int64_t> pairs_in_row;
    std::vector<std::uint64_t> wanted;  // blocks asked for, bin by bin; empty: all
    Buffer<BlockEnd<T>> ends;           // [bins, 64]
    Bins bins;                          // the band listed last
  };

  void ask_for(View& view, const std::optional<Demand>& demand) {
    view.wanted.clear();
    view.bins.end_row = view.bins.first_row = 0;
    if (!demand) return;
    const Screen<T>& s = view.target.screen;
    view.wanted.assign(std::size_t(s.columns()) * s.rows(), 0);
    for (int by = 0; by * kBlock < s.height; ++by)
      for (int bx = 0; bx * kBlock < s.width; ++bx)
        if (demand->tiles[by * kBlock / demand->edge * demand->columns + bx * kBlock / demand->edge])
          view.wanted[by / kBlocksAcross * s.columns() + bx / kBlocksAcross] |=
              std::uint64_t(1) << (by % kBlocksAcross * kBlocksAcross + bx % kBlocksAcross);
  }

  // Cut the rows of bins so that each band's pairs fit the budget: [0, …, rows].
  std::vector<int> bands_of(const View& view, std::int64_t bytes_per_pair) const {
    std::vector<int> bands = {0};
    std::int64_t held = 0;
    const int rows = int(view.pairs_in_row.size());
    for (int row = 0; row < rows; ++row) {
      const std::int64_t here = view.pairs_in_row[row] * bytes_per_pair;
      if (here > budget_ || view.pairs_in_row[row] > std::int64_t(UINT32_MAX)) refuse(view, row, here);
      if (held && (held + here > budget_ || (held + here) / bytes_per_pair > std::int64_t(UINT32_MAX)))
        bands.push_back(row), held = 0;
      held += here;
    }
    bands.push_back(rows);
    return bands;
  }

  [[noreturn]] void refuse(const View& view, int row, std::int64_t bytes) const {
    std::int64_t largest = 0;
    for (std::int64_t i = 0; i < n_; ++i)
      if (view.target.ranges[i].count() > view.target.ranges[largest].count()) largest = i;
    const Ellipse<T>& e = view.target.ellipses[largest];
    throw OverBudget("one row of bins (32 px) holds " + std::to_string(view.pairs_in_row[row]) +
                     " pairs of Gaussian and bin, " + std::to_string(bytes >> 20) + " MiB of the " +
                     std::to_string(budget_ >> 20) + " MiB that `memory` allows. The largest Gaussian is number " +
                     std::to_string(largest) + ", " + std::to_string(std::int64_t(std::min<T>(2 * e.half_x, T(1e9)))) +
                     " px wide. Raise `memory`, or remove Gaussians that large.");
  }

  void list(View& view, int first_row, int end_row, int threads) {
    list_pairs(view.target.screen.columns(), first_row, end_row, order_, view.target.ranges, n_,
               view.wanted.empty() ? nullptr : view.wanted.data(), view.bins, threads);
  }

  std::uint64_t blocks(const View& view, int bin_x, int bin_y) const {
    const Screen<T>& s = view.target.screen;
    const std::uint64_t inside = blocks_in_image(bin_x, bin_y, s.width, s.height);
    return view.wanted.empty() ? inside : inside & view.wanted[bin_y * s.columns() + bin_x];
  }

  static Segment<T>& segment() {
    static thread_local Segment<T> mine;
    return mine;
  }

  void draw_band(View& view, T* image, T* alpha, int threads) {
    Bins& bins = view.bins;
    const Screen<T>& screen = view.target.screen;
    Pool::instance().run(threads, bins.bins(), [&](std::int64_t bin) {
      const int bin_x = int(bin) % bins.columns, bin_y = bins.first_row + int(bin) / bins.columns;
      const std::uint64_t inside = blocks_in_image(bin_x, bin_y, screen.width, screen.height);
      const std::uint64_t wanted = blocks(view, bin_x, bin_y);
      BlockEnd<T>* ends = view.ends.data() + (std::size_t(bin_y) * bins.columns + bin_x) * kBlocks;
      static thread_local BlockColour<T> scratch[kBlocks];
      BlockColour<T>* colours = scratch;
      for (std::uint64_t m = inside; m; m &= m - 1) {
        const int b = __builtin_ctzll(m);
        std::fill_n(ends[b].transmittance, kLanes, T(1));
        std::fill_n(ends[b].ended, kLanes, INT_MAX);
        colours[b] = {};
      }
      const std::int64_t n = bins.starts[bin + 1] - bins.starts[bin];
      std::uint64_t open = wanted;
      for (std::int64_t first = 0; first < n && open; first += kSegment) {
        Segment<T>& part = segment();
        gather(view.target.ellipses, bins, int(bin), first, wanted, part);
        for (std::uint64_t m = open; m; m &= m - 1) {
          const int b = __builtin_ctzll(m);
          if (!part.lengths[b]) continue;
          blend_block(part, b, bin_x * kBin + b % kBlocksAcross * kBlock, bin_y * kBin + b / kBlocksAcross * kBlock,
                      settings_, colours[b], ends[b]);
          if (first + kSegment < n && ends[b].finished()) open &= ~(std::uint64_t(1) << b);
        }
      }
      for (std::uint64_t m = inside; m; m &= m - 1) {
        const int b = __builtin_ctzll(m);
        show(screen, bin_x * kBin + b % kBlocksAcross * kBlock, bin_y * kBin + b / kBlocksAcross * kBlock, colours[b],
             ends[b], image, alpha);
      }
    });
    bins.has_masks = true;
  }

  void show(const Screen<T>& screen, int X, int Y, const BlockColour<T>& colour, const BlockEnd<T>& end, T* image,
            T* alpha) const {
    using L = Lanes<T>;
    const L through = L::load(end.transmittance), channels[3] = {L::load(colour.r), L::load(colour.g), L::load(colour.b)};
    L pixel[3], cover[1] = {L(T(1)) - through};
    for (int c = 0; c < 3; ++c) pixel[c] = channels[c] + through * L(settings_.background[c]);
    store_block<3>(image, screen.width, screen.height, X, Y, pixel);
    store_block<1>(alpha, screen.width, screen.height, X, Y, cover);
  }

  template <int K>
  void vjp_of(View& view, const T* cotangents, const Splats<T>& splats, const Gradients<T>& out, int threads) {
    const std::vector<int> bands = bands_of(view, kBytesPerPair + K * sizeof(Pulled<T>));
    const std::int64_t groups = groups_of(n_), per_task = 32;
    const bool whole = bands.size() == 2;
    if (!whole) {
      sums_.reserve_lost(std::size_t(n_) * K);
      std::memset(static_cast<void*>(sums_.data()), 0, sizeof(Pulled<T>) * n_ * K);
    }
    auto each_group = [&](auto&& visit) {
      Pool::instance().run(threads, (groups + per_task - 1) / per_task, [&](std::int64_t task) {
        for (std::int64_t g = task * per_task; g < std::min(groups, (task + 1) * per_task); ++g) visit(g);
      });
    };
    for (std::size_t b = 0; b + 1 < bands.size(); ++b) {
      if (view.bins.first_row != bands[b] || view.bins.end_row != bands[b + 1]) list(view, bands[b], bands[b + 1], threads);
      sent_.reserve_lost(view.bins.pairs.size() * K);
      send_band<K>(view, cotangents, threads);
      if (whole) break;
      each_group([&](std::int64_t g) {
        const int count = int(std::min<std::int64_t>(kLanes, n_ - g * kLanes));
        Lanes<T> rows[K][kLanes];
        for (int k = 0; k < K; ++k)
          for (int i = 0; i < count; ++i) rows[k][i] = Lanes<T>::load(&sums_[(g * kLanes + i) * K + k].q);
        add_sent<T, K>(view.bins, g * kLanes, count, n_, sent_, rows);
        for (int k = 0; k < K; ++k)
          for (int i = 0; i < count; ++i) rows[k][i].store(&sums_[(g * kLanes + i) * K + k].q);
      });
    }
    each_group([&](std::int64_t g) {
      const std::int64_t first = g * kLanes;
      const int count = int(std::min<std::int64_t>(kLanes, n_ - first));
      Lanes<T> rows[K][kLanes];
      for (int k = 0; k < K; ++k)
        for (Lanes<T>& row : rows[k]) row = T(0);
      std::uint32_t touched = 0;
      if (whole) {
        const std::uint32_t* mine = view.bins.first.data() + first;
        for (int i = 0; i < count; ++i) touched |= std::uint32_t(mine[i + 1] > mine[i]) << i;
        add_sent<T, K>(view.bins, first, count, n_, sent_, rows);
      } else {
        for (int i = 0; i < count; ++i) {
          touched |= std::uint32_t(view.target.visible[first + i]) << i;
          for (int k = 0; k < K; ++k) rows[k][i] = Lanes<T>::load(&sums_[(first + i) * K + k].q);
        }
      }
      pull_group<T, K>(pose_, settings_, splats, view.target, palette_, g, rows, touched, out);
    });
  }

  // The bins of the band, back to front; every pair of the band is written.
  template <int K>
  void send_band(View& view, const T* cotangents, int threads) {
    Bins& bins = view.bins;
    const Screen<T>& screen = view.target.screen;
    const std::int64_t image = std::int64_t(screen.width) * screen.height * 3;
    Pool::instance().run(threads, bins.bins(), [&](std::int64_t bin) {
      const std::int64_t n = bins.starts[bin + 1] - bins.starts[bin];
      if (!n) return;
      const int bin_x = int(bin) % bins.columns, bin_y = bins.first_row + int(bin) / bins.columns;
      const std::uint64_t wanted = blocks(view, bin_x, bin_y);
      const BlockEnd<T>* ends = view.ends.data() + (std::size_t(bin_y) * bins.columns + bin_x) * kBlocks;
      static thread_local Passage<K> scratch;
      Passage<K>& mine = scratch;

      std::int64_t end = 0;  // nothing behind it has been drawn
      for (std::uint64_t m = wanted; m; m &= m - 1)
        for (std::int32_t e : ends[__builtin_ctzll(m)].ended) end = std::max<std::int64_t>(end, std::min<std::int64_t>(e, n));
      for (int k = 0; k < K; ++k)  // on its way while the Gaussians are gathered
        for (int y = bin_y * kBin; y < std::min(screen.height, (bin_y + 1) * kBin); ++y)
          for (int x = 0; x < 3 * kBin; x += kLanes)
            __builtin_prefetch(cotangents + k * image + (std::int64_t(y) * screen.width + bin_x * kBin) * 3 + x);
      bool entered = false;
      for (std::int64_t first = (n - 1) / kSegment * kSegment; first >= 0; first -= kSegment) {
        const std::int64_t count = std::min<std::int64_t>(kSegment, n - first);
        Pulled<T>* sums = sent_.data() + (bins.starts[bin] + first) * K;
        std::memset(static_cast<void*>(sums), 0, sizeof(Pulled<T>) * count * K);
        if (first < end) {
          Segment<T>& part = segment();
          gather(view.target.ellipses, bins, int(bin), first, wanted, part);
          if (!std::exchange(entered, true)) enter<K>(view, cotangents, bin_x, bin_y, wanted, ends, mine);
          for (std::uint64_t m = wanted; m; m &= m - 1) {
            const int b = __builtin_ctzll(m);
            if (part.lengths[b])
              blend_block_vjp<T, K>(part, b, bin_x * kBin + b % kBlocksAcross * kBlock,
                                    bin_y * kBin + b / kBlocksAcross * kBlock, settings_, ends[b], mine.cotangent[b], mine.back[b],
                                    sums);
          }
        }
      }
    });
    bins.has_masks = true;
  }

  // What a bin's blocks start the way back with.
  template <int K>
  struct Passage {
    BlockBack<T, K> back[kBlocks];
    T cotangent[kBlocks][K][3][kLanes];
  };

  template <int K>
  void enter(const View& view, const T* cotangents, int bin_x, int bin_y, std::uint64_t wanted, const BlockEnd<T>* ends,
             Passage<K>& out) const {
    using L = Lanes<T>;
    const Screen<T>& s = view.target.screen;
    for (std::uint64_t m = wanted; m; m &= m - 1) {
      const int b = __builtin_ctzll(m);
      const int X = bin_x * kBin + b % kBlocksAcross * kBlock, Y = bin_y * kBin + b / kBlocksAcross * kBlock;
      const L through = L::load(ends[b].transmittance);
      through.store(out.back[b].transmittance);
      for (int k = 0; k < K; ++k) {
        L v[3], light = T(0);
        load_block<3>(cotangents + std::int64_t(k) * s.width * s.height * 3, s.width, s.height, X, Y, v);
        for (int c = 0; c < 3; ++c) {
          light += v[c] * L(settings_.background[c]);
          v[c].store(out.cotangent[b][k][c]);
        }
        (through * light).store(out.back[b].behind[k]);
      }
    }
  }

  Settings<T> settings_;
  Pose<T> pose_;
  std::int64_t budget_, n_ = 0;
  Palette<T> palette_;
  Buffer<T> depths_;
  Buffer<std::uint32_t> order_;
  std::vector<View> views_;
  Buffer<Pulled<T>> sent_, sums_;  // by pair; by Gaussian, when there are several bands
};

}  // namespace clear
