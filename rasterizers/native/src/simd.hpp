// `Lanes<T>`: sixteen numbers at a time on every processor, for the 4 x 4 pixels of a block or for sixteen Gaussians.
//
// AVX-512 holds sixteen floats in one register; narrower processors use several registers for the same sixteen, so every
// other file is written once. Arithmetic uses the compiler's vector types; `Native` holds the operations they lack.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>
#include <type_traits>
#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace clear {

inline constexpr int kLanes = 16;

#if defined(CLEAR_DOUBLE)
#define CLEAR_INLINE inline  // for checks: quick to compile instead
#define CLEAR_LAMBDA
#else
#define CLEAR_INLINE inline __attribute__((always_inline))
#define CLEAR_LAMBDA __attribute__((always_inline))
#endif

#if defined(__AVX512F__)
inline constexpr int kRegisterBytes = 64;
#elif defined(__AVX2__)
inline constexpr int kRegisterBytes = 32;
#else
inline constexpr int kRegisterBytes = 16;
#endif

// One register of T: its type, the type of a comparison's result, and the operations that have no operator.
template <class T>
struct Portable {
  static constexpr int width = kRegisterBytes / sizeof(T);
  using Whole = std::conditional_t<sizeof(T) == 4, std::int32_t, std::int64_t>;
  typedef T Register __attribute__((vector_size(kRegisterBytes)));
  typedef Whole Integer __attribute__((vector_size(kRegisterBytes)));
  using Mask = Integer;  // all bits of a lane, or none

  static CLEAR_INLINE Mask less(Register a, Register b) { return (Mask)(a < b); }
  static CLEAR_INLINE Mask less_equal(Register a, Register b) { return (Mask)(a <= b); }
  static CLEAR_INLINE Register select(Mask m, Register a, Register b) { return m ? a : b; }
  static CLEAR_INLINE std::uint32_t bits(Mask m) {
#if defined(__AVX512F__)
    return _mm512_movepi64_mask((__m512i)m);  // of double; float has other masks
#elif defined(__AVX2__)
    return sizeof(T) == 4 ? _mm256_movemask_ps((__m256)m) : _mm256_movemask_pd((__m256d)m);
#elif defined(__SSE2__)
    return sizeof(T) == 4 ? _mm_movemask_ps((__m128)m) : _mm_movemask_pd((__m128d)m);
#endif
    std::uint32_t b = 0;
    for (int i = 0; i < width; ++i) b |= std::uint32_t(m[i] != 0) << i;
    return b;
  }
  static CLEAR_INLINE Mask from_bits(std::uint32_t b) {
    Mask m;
    for (int i = 0; i < width; ++i) m[i] = -Whole((b >> i) & 1);
    return m;
  }
  // NaN as on x86: the result is the second operand.
  static CLEAR_INLINE Register minimum(Register a, Register b) { return a < b ? a : b; }
  static CLEAR_INLINE Register maximum(Register a, Register b) { return a > b ? a : b; }
  static CLEAR_INLINE Register root(Register a) {
    for (int i = 0; i < width; ++i) a[i] = std::sqrt(a[i]);
    return a;
  }
  // Rounds by adding and subtracting 1.5 · 2^mantissa; valid for |a| < 2^22 (double: 2^51).
  static CLEAR_INLINE Register nearest(Register a) {
    constexpr T big = sizeof(T) == 4 ? T(12582912.0) : T(6755399441055744.0);
    return (a + big) - big;
  }
  // a · 2^n for an integer n.
  static CLEAR_INLINE Register scale_by_power(Register a, Register n) {
    constexpr int mantissa = sizeof(T) == 4 ? 23 : 52;
    constexpr T limit = sizeof(T) == 4 ? T(-126) : T(-1022);
    Integer e = __builtin_convertvector(maximum(n, limit - Register{}), Integer);
    Integer one = (Integer)(T(1) - Register{});
    return a * (Register)(one + (e << mantissa));
  }
  // a b + c and c - a b, rounded once where the processor can.
  static CLEAR_INLINE Register multiply_add(Register a, Register b, Register c) { return a * b + c; }
  static CLEAR_INLINE Register subtract_product(Register c, Register a, Register b) { return c - a * b; }
  // 1/a to about the precision of T.
  static CLEAR_INLINE Register reciprocal(Register a) { return T(1) / a; }
};

template <class T>
struct Native : Portable<T> {};

// Float in its own instructions. What the faster modules need of double is as fast as above: sums, products, comparisons, rounding.
#if defined(__AVX512F__)
template <>
struct Native<float> : Portable<float> {
  using Mask = __mmask16;  // one bit per lane
  static CLEAR_INLINE Mask less(Register a, Register b) { return _mm512_cmp_ps_mask(a, b, _CMP_LT_OQ); }
  static CLEAR_INLINE Mask less_equal(Register a, Register b) { return _mm512_cmp_ps_mask(a, b, _CMP_LE_OQ); }
  static CLEAR_INLINE Register select(Mask m, Register a, Register b) { return _mm512_mask_mov_ps(b, m, a); }
  static CLEAR_INLINE std::uint32_t bits(Mask m) { return m; }
  static CLEAR_INLINE Mask from_bits(std::uint32_t b) { return Mask(b); }
  static CLEAR_INLINE Register minimum(Register a, Register b) { return _mm512_min_ps(a, b); }
  static CLEAR_INLINE Register maximum(Register a, Register b) { return _mm512_max_ps(a, b); }
  static CLEAR_INLINE Register root(Register a) { return _mm512_sqrt_ps(a); }
  static CLEAR_INLINE Register nearest(Register a) { return _mm512_roundscale_ps(a, 0); }
  static CLEAR_INLINE Register scale_by_power(Register a, Register n) { return _mm512_scalef_ps(a, n); }
  static CLEAR_INLINE Register multiply_add(Register a, Register b, Register c) { return _mm512_fmadd_ps(a, b, c); }
  static CLEAR_INLINE Register subtract_product(Register c, Register a, Register b) { return _mm512_fnmadd_ps(a, b, c); }
  static CLEAR_INLINE Register reciprocal(Register a) {
    const Register r = _mm512_rcp14_ps(a);
    return r * (2.0f - a * r);  // one Newton step: 28 bits
  }
};
#elif defined(__AVX2__)
template <>
struct Native<float> : Portable<float> {
  static CLEAR_INLINE Register minimum(Register a, Register b) { return _mm256_min_ps(a, b); }
  static CLEAR_INLINE Register maximum(Register a, Register b) { return _mm256_max_ps(a, b); }
  static CLEAR_INLINE Register root(Register a) { return _mm256_sqrt_ps(a); }
  static CLEAR_INLINE Register multiply_add(Register a, Register b, Register c) { return _mm256_fmadd_ps(a, b, c); }
  static CLEAR_INLINE Register subtract_product(Register c, Register a, Register b) { return _mm256_fnmadd_ps(a, b, c); }
};
#endif

// Repeats a statement for each register i of sixteen numbers. Written out, because a compiler takes long to unroll the many
// loops of one to eight steps, and cannot simplify what they compute before that.
#if defined(CLEAR_DOUBLE)
#define CLEAR_EACH_REGISTER(...) for (int i = 0; i < registers; ++i) __VA_ARGS__
#else
#define CLEAR_ONE_REGISTER(n, ...)  \
  if constexpr (n < registers) {    \
    constexpr int i = n;            \
    __VA_ARGS__;                    \
  }
#define CLEAR_EACH_REGISTER(...)                                              \
  CLEAR_ONE_REGISTER(0, __VA_ARGS__) CLEAR_ONE_REGISTER(1, __VA_ARGS__)       \
  CLEAR_ONE_REGISTER(2, __VA_ARGS__) CLEAR_ONE_REGISTER(3, __VA_ARGS__)       \
  CLEAR_ONE_REGISTER(4, __VA_ARGS__) CLEAR_ONE_REGISTER(5, __VA_ARGS__)       \
  CLEAR_ONE_REGISTER(6, __VA_ARGS__) CLEAR_ONE_REGISTER(7, __VA_ARGS__)
#endif

template <class T>
struct Mask {
  static constexpr int registers = kLanes / Native<T>::width;
  typename Native<T>::Mask r[registers];

  CLEAR_INLINE Mask operator&(const Mask& o) const {
    Mask m;
    CLEAR_EACH_REGISTER(m.r[i] = r[i] & o.r[i]);
    return m;
  }
  CLEAR_INLINE Mask and_not(const Mask& o) const {
    Mask m;
    CLEAR_EACH_REGISTER(m.r[i] = r[i] & ~o.r[i]);
    return m;
  }
  CLEAR_INLINE std::uint32_t bits() const {
    std::uint32_t b = 0;
    CLEAR_EACH_REGISTER(b |= Native<T>::bits(r[i]) << (i * Native<T>::width));
    return b;
  }
  CLEAR_INLINE bool any() const {
    typename Native<T>::Mask some{};
    CLEAR_EACH_REGISTER(some |= r[i]);
    return Native<T>::bits(some) != 0;
  }
  static CLEAR_INLINE Mask from_bits(std::uint32_t b) {
    Mask m;
    CLEAR_EACH_REGISTER(m.r[i] = Native<T>::from_bits(b >> (i * Native<T>::width)));
    return m;
  }
};

template <class T>
struct Lanes {
  static constexpr int registers = kLanes / Native<T>::width;
  using Register = typename Native<T>::Register;
  // A register at any address. A compiler may copy memory in narrower moves, and a load must wait for several of them.
  typedef Register Unaligned __attribute__((aligned(alignof(T)), may_alias));
  Register r[registers];

  Lanes() = default;
  CLEAR_INLINE Lanes(T x) {
    CLEAR_EACH_REGISTER(r[i] = x - Register{});  // x - 0 is x, also for -0; compiles to a broadcast
  }
  static CLEAR_INLINE Lanes load(const T* p) {
    Lanes a;
    CLEAR_EACH_REGISTER(a.r[i] = reinterpret_cast<const Unaligned*>(p)[i]);
    return a;
  }
  CLEAR_INLINE void store(T* p) const {
    CLEAR_EACH_REGISTER(reinterpret_cast<Unaligned*>(p)[i] = r[i]);
  }
  // Stores past the caches, for what is not read again soon; `p` is aligned to sixteen numbers. Other threads see it only
  // after `end_of_stream`.
  CLEAR_INLINE void stream(T* p) const {
#if defined(__AVX512F__)
    if constexpr (sizeof(T) == 4) return _mm512_stream_ps(p, (__m512)r[0]);
#elif defined(__AVX2__)
    if constexpr (sizeof(T) == 4) {
      CLEAR_EACH_REGISTER(_mm256_stream_ps(p + i * Native<T>::width, (__m256)r[i]));
      return;
    }
#endif
    store(p);
  }

#define CLEAR_EACH(result, name, parameters, ...)   \
  friend CLEAR_INLINE result name parameters {      \
    result out;                                     \
    CLEAR_EACH_REGISTER(out.r[i] = __VA_ARGS__);    \
    return out;                                     \
  }
  CLEAR_EACH(Lanes, operator+, (const Lanes& a, const Lanes& b), a.r[i] + b.r[i])
  CLEAR_EACH(Lanes, operator-, (const Lanes& a, const Lanes& b), a.r[i] - b.r[i])
  CLEAR_EACH(Lanes, operator*, (const Lanes& a, const Lanes& b), a.r[i] * b.r[i])
  CLEAR_EACH(Lanes, operator/, (const Lanes& a, const Lanes& b), a.r[i] / b.r[i])
  CLEAR_EACH(Mask<T>, operator<, (const Lanes& a, const Lanes& b), Native<T>::less(a.r[i], b.r[i]))
  CLEAR_EACH(Mask<T>, operator<=, (const Lanes& a, const Lanes& b), Native<T>::less_equal(a.r[i], b.r[i]))
  CLEAR_EACH(Mask<T>, operator>, (const Lanes& a, const Lanes& b), Native<T>::less(b.r[i], a.r[i]))
  CLEAR_EACH(Mask<T>, operator>=, (const Lanes& a, const Lanes& b), Native<T>::less_equal(b.r[i], a.r[i]))
  CLEAR_EACH(Lanes, minimum, (const Lanes& a, const Lanes& b), Native<T>::minimum(a.r[i], b.r[i]))
  CLEAR_EACH(Lanes, maximum, (const Lanes& a, const Lanes& b), Native<T>::maximum(a.r[i], b.r[i]))
  CLEAR_EACH(Lanes, root, (const Lanes& a), Native<T>::root(a.r[i]))
  CLEAR_EACH(Lanes, nearest, (const Lanes& a), Native<T>::nearest(a.r[i]))
  CLEAR_EACH(Lanes, scale_by_power, (const Lanes& a, const Lanes& n), Native<T>::scale_by_power(a.r[i], n.r[i]))
  CLEAR_EACH(Lanes, reciprocal, (const Lanes& a), Native<T>::reciprocal(a.r[i]))
  CLEAR_EACH(Lanes, multiply_add, (const Lanes& a, const Lanes& b, const Lanes& c),
             Native<T>::multiply_add(a.r[i], b.r[i], c.r[i]))
  CLEAR_EACH(Lanes, subtract_product, (const Lanes& c, const Lanes& a, const Lanes& b),
             Native<T>::subtract_product(c.r[i], a.r[i], b.r[i]))
  CLEAR_EACH(Lanes, select, (const Mask<T>& m, const Lanes& a, const Lanes& b), Native<T>::select(m.r[i], a.r[i], b.r[i]))
#undef CLEAR_EACH
  CLEAR_INLINE Lanes operator-() const { return Lanes(T(0)) - *this; }
  CLEAR_INLINE Lanes& operator+=(const Lanes& b) { return *this = *this + b; }
  CLEAR_INLINE Lanes& operator-=(const Lanes& b) { return *this = *this - b; }
  CLEAR_INLINE Lanes& operator*=(const Lanes& b) { return *this = *this * b; }
};

// Comes after the last `stream` of a task.
inline void end_of_stream() {
#if defined(__AVX2__)
  _mm_sfence();
#endif
}

// The same sixteen numbers in another precision.
template <class To, class From>
CLEAR_INLINE Lanes<To> convert(const Lanes<From>& a) {
  if constexpr (sizeof(To) == sizeof(From)) {
    return a;
  } else {
    typedef From Given __attribute__((vector_size(sizeof(From) * kLanes)));
    typedef To Wanted __attribute__((vector_size(sizeof(To) * kLanes)));
    Given from;
    std::memcpy(&from, a.r, sizeof from);
    const Wanted to = __builtin_convertvector(from, Wanted);
    Lanes<To> out;
    std::memcpy(out.r, &to, sizeof to);
    return out;
  }
}

template <class T>
CLEAR_INLINE Lanes<T> absolute(const Lanes<T>& a) {
  return maximum(a, -a);
}
template <class T>
CLEAR_INLINE Lanes<T> clamp(const Lanes<T>& a, const Lanes<T>& low, const Lanes<T>& high) {
  return minimum(maximum(a, low), high);
}
template <class T>
CLEAR_INLINE Lanes<T> floor(const Lanes<T>& a) {
  Lanes<T> n = nearest(a);
  return n - select(n > a, Lanes<T>(T(1)), Lanes<T>(T(0)));
}
template <class T>
CLEAR_INLINE Lanes<T> where(const Mask<T>& m, const Lanes<T>& a) {
  return select(m, a, Lanes<T>(T(0)));
}

// 2^x. In float a polynomial of degree 5 on [-1/2, 1/2], relative error 1e-7; in double, which is for checking, libm.
template <class T>
CLEAR_INLINE Lanes<T> exp2(const Lanes<T>& x) {
  if constexpr (sizeof(T) == 4) {
    auto power = [](const Lanes<T>& f) CLEAR_LAMBDA {
      Lanes<T> p = T(1.32647e-3);
      p = p * f + T(9.67151e-3);
      p = p * f + T(5.550734e-2);
      p = p * f + T(2.4022242e-1);
      p = p * f + T(6.9314698e-1);
      return p * f + T(1);
    };
#if defined(__AVX512F__)
    const Lanes<T> n = nearest(x);
    return scale_by_power(power(x - n), n);
#else
    // The last bits of x + 1.5 · 2^23 are the nearest integer; added to a float's exponent, they multiply by its power of two.
    constexpr int registers = Lanes<T>::registers, mantissa = 23;
    const Lanes<T> big = T(12582912.0), bounded = maximum(Lanes<T>(T(-125)), x), sum = bounded + big;  // NaN stays NaN
    Lanes<T> p = power(bounded - (sum - big));
    using Integer = typename Native<T>::Integer;
    using Register = typename Native<T>::Register;
    CLEAR_EACH_REGISTER(p.r[i] = (Register)((Integer)p.r[i] + ((Integer)sum.r[i] << mantissa)));
    return p;
#endif
  } else {
    T a[kLanes];
    x.store(a);
    for (T& v : a) v = std::exp2(v);
    return Lanes<T>::load(a);
  }
}

// log2 x for x > 0.
template <class T>
CLEAR_INLINE Lanes<T> log2(const Lanes<T>& x) {
  if constexpr (sizeof(T) == 4) {
    // x = m 2^e with m in [√½, √2);  log2 m = 2/ln 2 · artanh s,  s = (m - 1)/(m + 1).
    constexpr int registers = Lanes<T>::registers, mantissa = 23, sqrt_half = 0x3f3504f3;
    using Integer = typename Native<T>::Integer;
    using Register = typename Native<T>::Register;
    Lanes<T> m, exponent;
    CLEAR_EACH_REGISTER({
      const Integer e = ((Integer)x.r[i] - sqrt_half) >> mantissa;
      m.r[i] = (Register)((Integer)x.r[i] - (e << mantissa));
      exponent.r[i] = __builtin_convertvector(e, Register);
    });
    const Lanes<T> s = (m - T(1)) / (m + T(1)), s2 = s * s;
    Lanes<T> p = T(1.0 / 9);
    p = p * s2 + T(1.0 / 7);
    p = p * s2 + T(1.0 / 5);
    p = p * s2 + T(1.0 / 3);
    p = p * s2 + T(1);
    return exponent + s * p * T(2.8853900817779268);
  } else {
    T a[kLanes];
    x.store(a);
    for (T& v : a) v = std::log2(v);
    return Lanes<T>::load(a);
  }
}

}  // namespace clear
