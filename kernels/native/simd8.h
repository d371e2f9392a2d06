// Scalars of laws: float, double, ``dual_of`` either, with a derivative, or ``lanes8``, eight floats in a CPU's vector
// registers; triples of these; and how lanes are read and written. CUDA has no lanes.
#pragma once

// Functions that are called more than once must not pass vectors through memory.
#if defined(__CUDACC__)
#define COROT_INLINE __device__ __forceinline__
#else
#define COROT_INLINE inline __attribute__((always_inline))
#endif
#if defined(__clang__)
#pragma clang fp contract(fast)
#endif

namespace corot {

// --- lanes ----------------------------------------------------------------------------------------------------------

#if !defined(__CUDACC__)
typedef float lanes8 __attribute__((vector_size(32)));
typedef int masks8 __attribute__((vector_size(32)));
// As they stand in memory, where nothing is aligned.
typedef float packed8 __attribute__((vector_size(32), aligned(4)));
typedef float packed4 __attribute__((vector_size(16), aligned(4)));
#endif

// --- scalars --------------------------------------------------------------------------------------------------------

// What a comparison of scalars gives.
template <class S> struct mask { typedef bool type; };
template <class S> using mask_of = typename mask<S>::type;

template <class A, class B> struct same { static constexpr bool value = false; };
template <class A> struct same<A, A> { static constexpr bool value = true; };

template <class S> struct constant { static COROT_INLINE S of(double a) { return static_cast<S>(a); } };
template <class S> COROT_INLINE S spread(double a) { return constant<S>::of(a); }
template <class S> COROT_INLINE mask_of<S> every() { return spread<S>(0.0f) == spread<S>(0.0f); }

COROT_INLINE bool any(bool a) { return a; }
COROT_INLINE bool inverted(bool a) { return !a; }

// A quotient and a root: on CUDA those of floats are accurate to the last digit but one, in one instruction.
template <class A, class B> COROT_INLINE auto over(const A& a, const B& b) { return a / b; }
#if defined(__CUDACC__)
COROT_INLINE float over(float a, float b) {
    float inverse;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(b));
    return a * inverse;
}
COROT_INLINE float log_of_large(float a) { return ::logf(a); }
COROT_INLINE float power_of(float x) { return ::expf(x); }
COROT_INLINE float magnitude(float a) { return ::fabsf(a); }
COROT_INLINE float root(float a) {
    float r;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(a));
    return r;
}
COROT_INLINE double root(double a) { return ::sqrt(a); }
#else
COROT_INLINE float log_of_large(float a) { return __builtin_logf(a); }
COROT_INLINE float power_of(float x) { return __builtin_expf(x); }
COROT_INLINE float magnitude(float a) { return __builtin_fabsf(a); }
COROT_INLINE float root(float a) { return __builtin_sqrtf(a); }
COROT_INLINE double root(double a) { return __builtin_sqrt(a); }
#endif

// A number and its derivative in some direction, so that a law's stress has its differential.
template <class T> struct dual_of {
    T value, slope;
    COROT_INLINE dual_of() = default;
    COROT_INLINE dual_of(T value, T slope = 0) : value(value), slope(slope) {}
    COROT_INLINE dual_of operator-() const { return {-value, -slope}; }
    COROT_INLINE dual_of& operator+=(const dual_of& b) { return *this = *this + b; }
    COROT_INLINE dual_of& operator-=(const dual_of& b) { return *this = *this - b; }
    friend COROT_INLINE dual_of operator+(const dual_of& a, const dual_of& b) { return {a.value + b.value, a.slope + b.slope}; }
    friend COROT_INLINE dual_of operator+(const dual_of& a, T b) { return {a.value + b, a.slope}; }
    friend COROT_INLINE dual_of operator+(T a, const dual_of& b) { return {a + b.value, b.slope}; }
    friend COROT_INLINE dual_of operator-(const dual_of& a, const dual_of& b) { return {a.value - b.value, a.slope - b.slope}; }
    friend COROT_INLINE dual_of operator-(const dual_of& a, T b) { return {a.value - b, a.slope}; }
    friend COROT_INLINE dual_of operator-(T a, const dual_of& b) { return {a - b.value, -b.slope}; }
    friend COROT_INLINE dual_of operator*(const dual_of& a, const dual_of& b) {
        return {a.value * b.value, a.slope * b.value + a.value * b.slope};
    }
    friend COROT_INLINE dual_of operator*(const dual_of& a, T b) { return {a.value * b, a.slope * b}; }
    friend COROT_INLINE dual_of operator*(T a, const dual_of& b) { return {a * b.value, a * b.slope}; }
    friend COROT_INLINE dual_of operator/(const dual_of& a, const dual_of& b) {
        const T inverse = over(T(1), b.value), quotient = a.value * inverse;
        return {quotient, (a.slope - quotient * b.slope) * inverse};
    }
    friend COROT_INLINE bool operator<(const dual_of& a, const dual_of& b) { return a.value < b.value; }
    friend COROT_INLINE bool operator>(const dual_of& a, const dual_of& b) { return a.value > b.value; }
    friend COROT_INLINE bool operator==(const dual_of& a, const dual_of& b) { return a.value == b.value; }
};
typedef dual_of<double> dual;
template <class S> constexpr bool IS_FINE = same<S, double>::value || same<S, dual>::value;

template <class T> COROT_INLINE dual_of<T> root(const dual_of<T>& a) {
    const T r = root(a.value);
    return {r, over(T(0.5) * a.slope, r)};
}

// ln(1 + d) and d - ln(1 + d), both to all their digits: ln(1 + d) = 2 artanh(s) with s = d / (2 + d), a series to s^11 where
// |s| <= 1/3, which leaves out 1.4e-7 at most.
COROT_INLINE float log_of(float d, float& excess) {
    const float s = over(d, 2.0f + d), z = s * s;
    const float series = z * (1.0f / 3 + z * (1.0f / 5 + z * (1.0f / 7 + z * (1.0f / 9 + z * (1.0f / 11)))));
    float log = 2.0f * s * (1.0f + series);
    excess = s * (d - 2.0f * series);
    if (d > 1.0f || d < -0.5f) log = log_of_large(1.0f + d), excess = d - log;
    return log;
}

// ln(1 + j) of positive 1 + j, and exp(x) - 1, to all their digits.
#if defined(__CUDACC__)
COROT_INLINE float log_of(float j) {
    float excess;
    return log_of(j, excess);
}
COROT_INLINE double log_of(double j) { return ::log1p(j); }
COROT_INLINE float power_excess(float x) { return ::expm1f(x); }
COROT_INLINE double power_excess(double x) { return ::expm1(x); }
#else
COROT_INLINE float log_of(float j) { return __builtin_log1pf(j); }
COROT_INLINE double log_of(double j) { return __builtin_log1p(j); }
COROT_INLINE float power_excess(float x) { return __builtin_expm1f(x); }
COROT_INLINE double power_excess(double x) { return __builtin_expm1(x); }
#endif
template <class T> COROT_INLINE dual_of<T> log_of(const dual_of<T>& j) { return {log_of(j.value), over(j.slope, T(1) + j.value)}; }
template <class T> COROT_INLINE dual_of<T> power_excess(const dual_of<T>& x) {
    const T excess = power_excess(x.value);
    return {excess, (T(1) + excess) * x.slope};
}

#if !defined(__CUDACC__)
template <> struct mask<lanes8> { typedef masks8 type; };
template <> struct constant<lanes8> {
    static COROT_INLINE lanes8 of(float a) { return lanes8{a, a, a, a, a, a, a, a}; }
};

COROT_INLINE bool any(const masks8& a) {
#if defined(__clang__)
    return __builtin_reduce_or(a) != 0;
#else
    int found = 0;
    for (int lane = 0; lane < 8; ++lane) found |= a[lane];
    return found != 0;
#endif
}
COROT_INLINE masks8 inverted(const masks8& a) { return ~a; }

COROT_INLINE lanes8 root(const lanes8& a) {
#if defined(__clang__)
    return __builtin_elementwise_sqrt(a);
#else
    lanes8 b;
    for (int lane = 0; lane < 8; ++lane) b[lane] = __builtin_sqrtf(a[lane]);
    return b;
#endif
}

// Of positive 1 + j: twice the artanh of j / (2 + j), of what powers of two leave within sqrt(2).
COROT_INLINE lanes8 log_of(const lanes8& j) {
    const lanes8 whole = 1.0f + j;
    const masks8 bits = reinterpret_cast<const masks8&>(whole);
    const masks8 power = (bits - 0x3f3504f3) >> 23;
    const masks8 reduced = bits - (power << 23);
    const lanes8 rest = power == 0 ? j : reinterpret_cast<const lanes8&>(reduced) - 1.0f;
    const lanes8 z = rest / (2.0f + rest), zz = z * z;
    const lanes8 series = 1.0f + zz * (1.0f / 3 + zz * (0.2f + zz * (1.0f / 7 + zz * (1.0f / 9))));
    return 0.6931472f * __builtin_convertvector(power, lanes8) + 2.0f * z * series;
}

// Of x up to 80: powers of two, and a series of what they leave within ln(2) / 2.
COROT_INLINE lanes8 power_excess(const lanes8& x) {
    const lanes8 bounded = x < -80.0f ? spread<lanes8>(-80.0f) : x;
    const lanes8 near = 1.4426950f * bounded + (bounded < 0.0f ? spread<lanes8>(-0.5f) : spread<lanes8>(0.5f));
    const masks8 power = __builtin_convertvector(near, masks8);
    const lanes8 whole = __builtin_convertvector(power, lanes8);
    const lanes8 r = (bounded - 0.693359375f * whole) + 2.1219444e-4f * whole;
    const lanes8 series = r + r * r * (0.5f + r * (1.0f / 6 + r * (1.0f / 24 + r * (1.0f / 120 + r * (1.0f / 720
        + r * (1.0f / 5040))))));
    const masks8 bits = (power + 127) << 23;
    const lanes8 scale = reinterpret_cast<const lanes8&>(bits);
    return scale * series + (scale - 1.0f);
}
#endif

// --- triples --------------------------------------------------------------------------------------------------------

// Numbers that do not change may stand beside dual ones.
template <class S> struct triple {
    S x, y, z;
    template <class W> COROT_INLINE auto operator+(const triple<W>& b) const { return triple<decltype(x + b.x)>{x + b.x, y + b.y, z + b.z}; }
    template <class W> COROT_INLINE auto operator-(const triple<W>& b) const { return triple<decltype(x - b.x)>{x - b.x, y - b.y, z - b.z}; }
    COROT_INLINE triple operator-() const { return {-x, -y, -z}; }
    template <class W> COROT_INLINE auto operator*(const W& w) const { return triple<decltype(w * x)>{w * x, w * y, w * z}; }
};

// a + w b
template <class A, class W, class B> COROT_INLINE auto added(const triple<A>& a, const W& w, const triple<B>& b) {
    return triple<decltype(a.x + w * b.x)>{a.x + w * b.x, a.y + w * b.y, a.z + w * b.z};
}

// u a + v b + w c
template <class W, class S> COROT_INLINE auto combined(const W& u, const triple<S>& a, const W& v, const triple<S>& b, const W& w,
        const triple<S>& c) {
    return triple<decltype(u * a.x)>{u * a.x + v * b.x + w * c.x, u * a.y + v * b.y + w * c.y, u * a.z + v * b.z + w * c.z};
}

template <class A, class B> COROT_INLINE auto dot(const triple<A>& a, const triple<B>& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

template <class A, class B> COROT_INLINE auto cross(const triple<A>& a, const triple<B>& b) {
    return triple<decltype(a.x * b.x)>{a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

template <class S> COROT_INLINE triple<S> chosen(const mask_of<S>& which, const triple<S>& a, const triple<S>& b) {
    return {which ? a.x : b.x, which ? a.y : b.y, which ? a.z : b.z};
}

template <class S> COROT_INLINE triple<S> nothing() { return {spread<S>(0.0f), spread<S>(0.0f), spread<S>(0.0f)}; }

// P = F S of a symmetric S: 00, 11, 22, 01, 02, 12, as all symmetric tensors here.
template <class A, class W, class S> COROT_INLINE void times(const triple<A>* f, const W* s, triple<S>* p) {
    p[0] = combined(s[0], f[0], s[3], f[1], s[4], f[2]);
    p[1] = combined(s[3], f[0], s[1], f[1], s[5], f[2]);
    p[2] = combined(s[4], f[0], s[5], f[1], s[2], f[2]);
}

#if !defined(__CUDACC__)
// --- memory ---------------------------------------------------------------------------------------------------------
//
// Memory is read and written four floats of a lane at a time and transposed in registers: written float by float, lanes
// would be read before the stores have arrived. ``at`` gives the address of a lane.

COROT_INLINE packed4 load4(const float* at) { return *reinterpret_cast<const packed4*>(at); }
COROT_INLINE lanes8 load8(const float* at) { return *reinterpret_cast<const packed8*>(at); }
COROT_INLINE void store8(float* at, const lanes8& a) { *reinterpret_cast<packed8*>(at) = a; }

COROT_INLINE lanes8 halves(const float* low, const float* high) {
    const packed4 a = load4(low), b = load4(high);
    return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7);
}

// One float in each lane.
template <class At> COROT_INLINE lanes8 gather_one(const At& at) {
    return lanes8{*at(0), *at(1), *at(2), *at(3), *at(4), *at(5), *at(6), *at(7)};
}

// Four floats in each lane.
template <class At> COROT_INLINE void gather(const At& at, lanes8* to) {
    const lanes8 r0 = halves(at(0), at(4)), r1 = halves(at(1), at(5));
    const lanes8 r2 = halves(at(2), at(6)), r3 = halves(at(3), at(7));
    const lanes8 a = __builtin_shufflevector(r0, r1, 0, 8, 1, 9, 4, 12, 5, 13);
    const lanes8 b = __builtin_shufflevector(r2, r3, 0, 8, 1, 9, 4, 12, 5, 13);
    const lanes8 c = __builtin_shufflevector(r0, r1, 2, 10, 3, 11, 6, 14, 7, 15);
    const lanes8 d = __builtin_shufflevector(r2, r3, 2, 10, 3, 11, 6, 14, 7, 15);
    to[0] = __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13);
    to[1] = __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
    to[2] = __builtin_shufflevector(c, d, 0, 1, 8, 9, 4, 5, 12, 13);
    to[3] = __builtin_shufflevector(c, d, 2, 3, 10, 11, 6, 7, 14, 15);
}

// A vector of a node in each lane.
template <class At> COROT_INLINE triple<lanes8> gather_vector(const At& at) {
    lanes8 four[4];
    gather(at, four);
    return {four[0], four[1], four[2]};
}

// The nine entries of a matrix in each lane, row by row.
template <class At> COROT_INLINE void gather_matrix(const At& at, lanes8* to) {
    gather(at, to);
    gather([&](int lane) { return at(lane) + 4; }, to + 4);
    to[8] = gather_one([&](int lane) { return at(lane) + 8; });
}

// The triple of each lane as four floats, lanes ``stride`` apart.
COROT_INLINE void part(const triple<lanes8>& a, packed4* to, int stride) {
    const lanes8 zero = spread<lanes8>(0.0f);
    const lanes8 xy = __builtin_shufflevector(a.x, a.y, 0, 8, 1, 9, 4, 12, 5, 13);
    const lanes8 z0 = __builtin_shufflevector(a.z, zero, 0, 8, 1, 9, 4, 12, 5, 13);
    const lanes8 xy_ = __builtin_shufflevector(a.x, a.y, 2, 10, 3, 11, 6, 14, 7, 15);
    const lanes8 z0_ = __builtin_shufflevector(a.z, zero, 2, 10, 3, 11, 6, 14, 7, 15);
    to[0] = __builtin_shufflevector(xy, z0, 0, 1, 8, 9);
    to[stride] = __builtin_shufflevector(xy, z0, 2, 3, 10, 11);
    to[2 * stride] = __builtin_shufflevector(xy_, z0_, 0, 1, 8, 9);
    to[3 * stride] = __builtin_shufflevector(xy_, z0_, 2, 3, 10, 11);
    to[4 * stride] = __builtin_shufflevector(xy, z0, 4, 5, 12, 13);
    to[5 * stride] = __builtin_shufflevector(xy, z0, 6, 7, 14, 15);
    to[6 * stride] = __builtin_shufflevector(xy_, z0_, 4, 5, 12, 13);
    to[7 * stride] = __builtin_shufflevector(xy_, z0_, 6, 7, 14, 15);
}

COROT_INLINE void add4(float* to, const packed4& a) { *reinterpret_cast<packed4*>(to) += a; }
#endif

}  // namespace corot
