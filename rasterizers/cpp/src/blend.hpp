// Blends a block of 4 x 4 pixels front to back; its VJP for K image cotangents runs back to front.
//
//   α_i = min(α_max, 2^(…)),   T_i = Π_{j<i} (1 - α_j),   I = Σ T_i α_i c_i + T_end · background
//
// A Gaussian with α_i < α_min is skipped; a pixel ends before the Gaussian that would take its T below transmittance_min.
//
// C is the number of channels that are drawn: kColour, or kColourAndDepth with expected depth, E = Σ T_i α_i z_i / Σ T_i α_i. In the
// VJP it is that of the cotangents, of which the fourth is that of Σ T_i α_i z_i.
#pragma once

#include <climits>

#include "blocks.hpp"
#include "columns.hpp"

namespace clear {

// The centres of a block's sixteen pixels, row by row, relative to the bin's corner like a segment's Gaussians.
template <class T>
struct PixelCentres {
  Lanes<T> x, y;
  explicit CLEAR_INLINE PixelCentres(int block) {
    const int X = block % kBlocksAcross * kBlock, Y = block / kBlocksAcross * kBlock;
    T px[kLanes], py[kLanes];
    for (int i = 0; i < kLanes; ++i) px[i] = T(X + i % kBlock) + T(0.5), py[i] = T(Y + i / kBlock) + T(0.5);
    x = Lanes<T>::load(px), y = Lanes<T>::load(py);
    if constexpr (Native<T>::width % kBlock == 0)
      for (auto& same : x.r) same = x.r[0];  // whole rows of pixels: the compiler keeps one register of dx, too
  }
};

// What the backward pass needs of each pixel: its final T, and the first pair of the bin that it did not blend.
template <class T>
struct BlockEnd {
  T transmittance[kLanes];
  std::int32_t ended[kLanes];  // INT_MAX: it blended the whole list

  bool finished() const { return std::find(ended, ended + kLanes, INT_MAX) == ended + kLanes; }
};

// What a block has blended: Σ w times each channel, and with depth Σ w, because 1 - T has no digits left where little is
// drawn.
template <class T, int C>
struct BlockBlend {
  static constexpr int kSums = C == kColourAndDepth ? C + 1 : C;
  T sums[kSums][kLanes];
};

// Loads a block's pixels from a [height, width, C] image; zeros beyond the image's edge. Whole blocks go from memory to
// registers at once: a load must wait where it reads what several narrower stores, or one wider store, have just written.
template <int C, class T>
CLEAR_INLINE void load_block(const T* image, int width, int height, int X, int Y, Lanes<T> (&channels)[C]) {
  const int columns = std::min(kBlock, width - X), rows = std::min(kBlock, height - Y);
  if constexpr (sizeof(T) == 4)
    if (columns == kBlock && rows == kBlock)
      return split_rows<C>(image + (std::int64_t(Y) * width + X) * C, std::ptrdiff_t(width) * C, channels);
  T pixels[kLanes * C] = {};
  for (int y = 0; y < rows; ++y)
    std::copy_n(image + (std::int64_t(Y + y) * width + X) * C, columns * C, pixels + y * kBlock * C);
  load_rows<C>(pixels, 0, kLanes, channels);
}

template <int C, class T>
CLEAR_INLINE void store_block(T* image, int width, int height, int X, int Y, const Lanes<T> (&channels)[C]) {
  const int columns = std::min(kBlock, width - X), rows = std::min(kBlock, height - Y);
  if constexpr (sizeof(T) == 4)
    if (columns == kBlock && rows == kBlock)
      return join_rows<C>(image + (std::int64_t(Y) * width + X) * C, std::ptrdiff_t(width) * C, channels);
  T pixels[kLanes * C];
  store_rows<C>(pixels, 0, kLanes, channels);
  for (int y = 0; y < rows; ++y)
    std::copy_n(pixels + y * kBlock * C, columns * C, image + (std::int64_t(Y + y) * width + X) * C);
}

// log2 of a Gaussian's α before the cap, at the pixels.
template <class T>
CLEAR_INLINE Lanes<T> exponent(const Ellipse<T>& e, const Lanes<T>& dx, const Lanes<T>& dy) {
  using L = Lanes<T>;
  const L u = dx + L(e.S) * dy;
  return L(e.peak) - L(e.A) * u * u - L(e.D) * dy * dy;
}

// Blends one segment into a block; segments after the first continue from `out` and `end`.
template <class T, int C>
void blend_block(const Segment<T>& segment, int block, const Settings<T>& s, BlockBlend<T, C>& out, BlockEnd<T>& end) {
  using L = Lanes<T>;
  constexpr int kSums = BlockBlend<T, C>::kSums;
  const PixelCentres<T> pixel(block);
  const L alpha_min = s.alpha_min, alpha_max = s.alpha_max, transmittance_min = s.transmittance_min;
  L through = T(1), sums[kSums];
  for (L& sum : sums) sum = T(0);
  Mask<T> alive = Mask<T>::from_bits(0xffff);
  if (segment.first == 0) {
    std::fill_n(end.ended, kLanes, INT_MAX);
  } else {
    through = L::load(end.transmittance);
    for (int c = 0; c < kSums; ++c) sums[c] = L::load(out.sums[c]);
    std::uint32_t open = 0;
    for (int i = 0; i < kLanes; ++i) open |= std::uint32_t(end.ended[i] == INT_MAX) << i;
    alive = Mask<T>::from_bits(open);
  }
  const Ellipse<T>* ellipses = segment.ellipses.data();
  const std::uint16_t* list = segment.list(block);
  const int n = segment.lengths[block];
  for (int i = 0; i < n; ++i) {
    const Ellipse<T>& e = ellipses[list[i]];
    const L dx = pixel.x - L(e.u), dy = pixel.y - L(e.v);
    const L drawn = minimum(exp2(exponent(e, dx, dy)), alpha_max);
    const Mask<T> counts = (drawn >= alpha_min) & alive;
    if (!counts.any()) continue;
    const L alpha = where(counts, drawn);  // at 0 a pixel stays as it is
    // T (1 - α) with one rounding: T - weight loses digits for an α near 1, and the backward pass divides by 1 - α.
    L weight = through * alpha, after = subtract_product(through, through, alpha);
    const Mask<T> ends = after < transmittance_min;  // of a pixel that ended before, T is still above
    const bool some_end = ends.any();
    if (__builtin_expect(some_end, 0)) {
      for (std::uint32_t m = ends.bits(); m; m &= m - 1)
        end.ended[__builtin_ctz(m)] = std::int32_t(segment.first) + list[i];
      alive = alive.and_not(ends);
      weight = select(ends, L(T(0)), weight), after = select(ends, through, after);
    }
    for (int c = 0; c < C; ++c) sums[c] += weight * L((&e.r)[c]);
    if constexpr (kSums > C) sums[C] += weight;
    through = after;
    if (__builtin_expect(some_end, 0) && !alive.any()) break;
  }
  through.store(end.transmittance);
  for (int c = 0; c < kSums; ++c) sums[c].store(out.sums[c]);
}

// Sums over a block's pixels for the Gaussians of its bin.
template <class T, int K, int C, bool Absolute>
struct BlockSums {
  using Sums = PairSums<T, K, C, Absolute>;
  static constexpr int kRows = kLanes;  // Gaussians are collected until every lane has one
  T q[K][kRows][kLanes], weight[kRows][kLanes];
  T offset_x[kRows], offset_y[kRows];  // from the Gaussian's centre to the block's
  T slope[kRows], conic[Absolute ? 2 : 1][kRows];  // S, and A and D without log2(e)/2
  int place[kRows];

  // Not inlined: two copies beside the loop over Gaussians would exceed the instruction cache.
  __attribute__((noinline)) void flush(int count, const T (&cotangent)[K][C][kLanes], Sums* sums) {
    if constexpr (kByQuads)
      for (int i = 0; i < count; ++i) add_by_quads(i, cotangent, sums);
    else if (count)
      add_by_transposes(count, cotangent, sums);
  }

 private:
  // Where sixteen rows do not fit the registers, each transpose would go through memory.
  static constexpr bool kByQuads = sizeof(T) == 4 && Lanes<T>::registers > 1;

  // A sum over pixels is the sum of a register's quads, four sums at a time.
  CLEAR_INLINE void add_by_quads(int row, const T (&cotangent)[K][C][kLanes], Sums* sums) const {
    using L = Lanes<T>;
    using Register = typename L::Register;
    constexpr int n = L::registers;
    const PixelCentres<T> pixel(0);
    const L dx = pixel.x + L(offset_x[row] - kBlock / 2), dy = pixel.y + L(offset_y[row] - kBlock / 2);
    const L S = slope[row], u = dx + S * dy, w = L::load(weight[row]);
    constexpr int total = K * Sums::kWidth;
    Register all[(total + kQuad - 1) / kQuad * kQuad];
    for (int i = total; i < int(std::size(all)); ++i) all[i] = Register{};
#pragma GCC unroll 3
    for (int k = 0; k < K; ++k) {
      const L v = L::load(q[k][row]), vu = v * u, vy = v * dy;
      const L moments[6] = {v, vu, vy, vu * u, vu * dy, vy * dy};
      Register* out = all + k * Sums::kWidth;
      for (int j = 0; j < 6; ++j) {
        out[j] = moments[j].r[0];
        for (int i = 1; i < n; ++i) out[j] += moments[j].r[i];
      }
      for (int c = 0; c < C; ++c) {
        const L parts = L::load(cotangent[k][c]);
        Register& sum = out[Sums::of_channel(c)] = w.r[0] * parts.r[0];
        for (int i = 1; i < n; ++i) sum += w.r[i] * parts.r[i];
      }
      if constexpr (Absolute) {
        const L along_u = L(conic[0][row]) * u;
        const L each[2] = {absolute(v * along_u), absolute(v * (S * along_u + L(conic[1][row]) * dy))};
        for (int c = 0; c < 2; ++c) {
          out[6 + kColour + c] = each[c].r[0];
          for (int i = 1; i < n; ++i) out[6 + kColour + c] += each[c].r[i];
        }
      }
    }
    T* out = sums[place[row]].numbers;
    auto quad = [&](int i) CLEAR_LAMBDA { return sum_quads(all[i], all[i + 1], all[i + 2], all[i + 3]); };
#pragma GCC unroll 4
    for (int i = 0; i < total; i += 2 * kQuad)
      if (i + kQuad < total) add_quads(out + i, quad(i), quad(i + kQuad));
      else add_quad(out + i, quad(i));
  }

  // Transposed, a lane is a Gaussian; a sum over pixels is then fifteen additions for sixteen Gaussians.
  CLEAR_INLINE void add_by_transposes(int count, const T (&cotangent)[K][C][kLanes], Sums* sums) {
    using L = Lanes<T>;
    for (int i = count; i < kRows; ++i) {
      L(T(0)).store(weight[i]);
      for (int k = 0; k < K; ++k) L(T(0)).store(q[k][i]);
      offset_x[i] = offset_y[i] = slope[i] = T(0);
      if constexpr (Absolute) conic[0][i] = conic[1][i] = T(0);
    }
    L w[kRows];
    for (int i = 0; i < kRows; ++i) w[i] = L::load(weight[i]);
    transpose(w);
    const L S = L::load(slope), oy = L::load(offset_y), ou = L::load(offset_x) + S * oy;
    L all[Sums::kRows][kLanes];
#pragma GCC unroll 3
    for (int k = 0; k < K; ++k) {
      L v[kRows], *out = all[0] + k * Sums::kWidth;
      for (int i = 0; i < kRows; ++i) v[i] = L::load(q[k][i]);
      transpose(v);
      moments(v, S, ou, oy, out);
      L channels[C];
      for (L& channel : channels) channel = T(0);
      for (int p = 0; p < kLanes; ++p)
        for (int c = 0; c < C; ++c) channels[c] += w[p] * L(cotangent[k][c][p]);
      for (int c = 0; c < C; ++c) out[Sums::of_channel(c)] = channels[c];
      if constexpr (Absolute) {
        out[6 + kColour] = out[7 + kColour] = L(T(0));
        for (int p = 0; p < kLanes; ++p) {
          const L y = T(p / kBlock) - T(1.5), along_u = L::load(conic[0]) * (ou + S * y + L(T(p % kBlock) - T(1.5)));
          out[6 + kColour] += absolute(v[p] * along_u);
          out[7 + kColour] += absolute(v[p] * (S * along_u + L::load(conic[1]) * (oy + y)));
        }
      }
    }
    constexpr int last = Sums::kRows - 1, rest = K * Sums::kWidth - last * kLanes;
    for (int r = 0; r < (rest > kQuad ? last + 1 : last); ++r) {
      if (r == last)
        for (int i = rest; i < kLanes; ++i) all[r][i] = T(0);
      transpose(all[r]);
      for (int i = 0; i < count; ++i) {
        T* row = sums[place[i]].numbers + r * kLanes;
        (L::load(row) + all[r][i]).store(row);
      }
    }
    if constexpr (rest <= kQuad) {
      L columns[rest];
      std::copy(all[last], all[last] + rest, columns);
      T rows[kLanes][rest];
      join_rows(rows[0], columns);
      for (int i = 0; i < count; ++i)
        for (int j = 0; j < rest; ++j) sums[place[i]].numbers[last * kLanes + j] += rows[i][j];
    }
  }

  // Σ v, Σ v·u, … about the Gaussian's centre, from the moments about the block's centre, whose offsets are constants.
  static CLEAR_INLINE void moments(const Lanes<T> (&v)[kLanes], const Lanes<T>& S, const Lanes<T>& ou, const Lanes<T>& oy,
                                   Lanes<T>* out) {
    using L = Lanes<T>;
    L m = T(0), mx = T(0), my = T(0), mxx = T(0), mxy = T(0), myy = T(0);
    for (int row = 0; row < kBlock; ++row) {
      const L &a = v[4 * row], &b = v[4 * row + 1], &c = v[4 * row + 2], &d = v[4 * row + 3];
      const L outer = a + d, inner = b + c, sum = outer + inner;
      const L first = L(T(1.5)) * (d - a) + L(T(0.5)) * (c - b), second = L(T(2.25)) * outer + L(T(0.25)) * inner;
      const L y = T(row) - T(1.5);
      m += sum, mx += first, mxx += second;
      my += y * sum, mxy += y * first, myy += y * y * sum;
    }
    const L mu = mx + S * my, muy = mxy + S * myy, muu = mxx + S * (mxy + muy);
    const L qu = mu + ou * m, qy = my + oy * m;
    out[0] = m, out[1] = qu, out[2] = qy;
    out[3] = muu + ou * (mu + qu);
    out[4] = muy + ou * my + oy * qu;
    out[5] = myy + oy * (my + qy);
  }
};

// What a block passes from segment to segment in the backward pass: T in front of the visited Gaussians, and for each
// cotangent what lies behind, Σ_{j>i} T_j α_j (c_j·v) + T_end (background·v - v_α), with v_α that of alpha = 1 - T_end.
template <class T, int K>
struct BlockBack {
  T transmittance[kLanes], behind[K][kLanes];
};

//   ∂I·v/∂α_i = T_i (c_i·v) - behind / (1 - α_i)
// Where α is capped, the image does not depend on the ellipse.
template <class T, int K, int C, bool Absolute>
void blend_block_vjp(const Segment<T>& segment, int block, const Settings<T>& s, const BlockEnd<T>& end,
                     const T (&cotangent)[K][C][kLanes], BlockBack<T, K>& back, PairSums<T, K, C, Absolute>* sums) {
  using L = Lanes<T>;
  const PixelCentres<T> pixel(block);
  const L alpha_min = s.alpha_min, alpha_max = s.alpha_max, one = T(1);
  const T centre_x = T(block % kBlocksAcross * kBlock) + T(kBlock) / 2;
  const T centre_y = T(block / kBlocksAcross * kBlock) + T(kBlock) / 2;
  const std::uint16_t* list = segment.list(block);

  // Where each pixel ended, counted from this segment's first pair; small integers, so exact in T.
  T ends[kLanes];
  const std::int32_t before = std::int32_t(segment.first);
  int last = 0;
  for (int i = 0; i < kLanes; ++i) {
    const int e = std::min(std::max(end.ended[i] - before, 0), kSegment);
    ends[i] = T(e), last = std::max(last, e);
  }
  const L ended = L::load(ends);
  int n = segment.lengths[block];
  if (last < segment.count) n = int(std::lower_bound(list, list + n, last) - list);
  if (!n) return;

  L through = L::load(back.transmittance), v[K][C], behind[K];
  for (int k = 0; k < K; ++k) {
    behind[k] = L::load(back.behind[k]);
    for (int c = 0; c < C; ++c) v[k][c] = L::load(cotangent[k][c]);
  }
  BlockSums<T, K, C, Absolute> collected;
  int count = 0;
  const Ellipse<T>* ellipses = segment.ellipses.data();
  for (int i = n - 1; i >= 0; --i) {
    const int place = list[i];
    const Ellipse<T>& e = ellipses[place];
    const L dx = pixel.x - L(e.u), dy = pixel.y - L(e.v);
    const L free = exp2(exponent(e, dx, dy)), capped = minimum(free, alpha_max);
    const Mask<T> kept = (capped >= alpha_min) & (ended > L(T(place)));
    if (!kept.any()) continue;
    const L alpha = where(kept, capped);
    const L over = reciprocal(one - alpha);
    through *= over;
    const L weight = through * alpha;
    const Mask<T> moves = kept & (free <= alpha_max);
    weight.store(collected.weight[count]);
    for (int k = 0; k < K; ++k) {
      L light = v[k][0] * L(e.r) + v[k][1] * L(e.g) + v[k][2] * L(e.b);
      if constexpr (C == kColourAndDepth) light += v[k][kColour] * L(e.z);
      const L d_alpha = through * light - behind[k] * over;
      where(moves, alpha * d_alpha).store(collected.q[k][count]);
      behind[k] += weight * light;
    }
    collected.offset_x[count] = centre_x - e.u;
    collected.offset_y[count] = centre_y - e.v;
    collected.slope[count] = e.S;
    collected.place[count] = place;
    if constexpr (Absolute)  // of the natural logarithm of alpha
      collected.conic[0][count] = 2 / kLog2E<T> * e.A, collected.conic[1][count] = 2 / kLog2E<T> * e.D;
    if (++count == collected.kRows) collected.flush(count, cotangent, sums), count = 0;
  }
  collected.flush(count, cotangent, sums);
  through.store(back.transmittance);
  for (int k = 0; k < K; ++k) behind[k].store(back.behind[k]);
}

}  // namespace clear
