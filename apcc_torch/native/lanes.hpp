// Arithmetic on LANES rows at once. REAL, INTEGER (of REAL's width) and LANES come from the generated program.
// A comparison of vectors gives a vector of masks, of single numbers a truth value; both serve as conditions below.
#include <cmath>
#include <cstring>

#if LANES == 1
typedef REAL V;
typedef INTEGER I;
typedef bool B;
static inline V splat(REAL x) { return x; }
static inline I splat_int(INTEGER x) { return x; }
static inline B splat_bool(bool x) { return x; }
static inline B not_(B x) { return !x; }
static inline V real(I x) { return (V)x; }
static inline I integer(V x) { return (I)x; }
static inline bool any(B x) { return x; }
#else
typedef REAL V __attribute__((vector_size(LANES * sizeof(REAL))));
typedef INTEGER I __attribute__((vector_size(LANES * sizeof(INTEGER))));
typedef decltype(V{} < V{}) B;
static inline V splat(REAL x) { return V{} + x; }
static inline I splat_int(INTEGER x) { return I{} + x; }
static inline B splat_bool(bool x) { return x ? ~B{} : B{}; }
static inline B not_(B x) { return ~x; }
static inline V real(I x) { return __builtin_convertvector(x, V); }
static inline I integer(V x) { return __builtin_convertvector(x, I); }
static inline bool any(B x) {
    for (int w = 0; w < LANES; ++w)
        if (x[w]) return true;
    return false;
}
#endif

static inline REAL& lane(V& x, int w) { return reinterpret_cast<REAL*>(&x)[w]; }
static inline INTEGER& lane_int(I& x, int w) { return reinterpret_cast<INTEGER*>(&x)[w]; }

// What is not a number wins, as in torch. The second operand is the one that is asked: along a row the first is all that
// came before, and a compiler takes the question apart down to its beginning.
static inline V max_(V a, V b) { return ((b > a) | (b != b)) ? b : a; }
static inline V min_(V a, V b) { return ((b < a) | (b != b)) ? b : a; }
static inline I max_int(I a, I b) { return a > b ? a : b; }
static inline I min_int(I a, I b) { return a < b ? a : b; }
static inline V abs_(V a) { return a < 0 ? -a : a; }
static inline B isfinite_(V a) { return a - a == splat(0); }

#define BY_LANE(name, call)                                    \
    static inline V name(V a) {                                \
        for (int w = 0; w < LANES; ++w) {                      \
            REAL x = lane(a, w);                               \
            lane(a, w) = call;                                 \
        }                                                      \
        return a;                                              \
    }
BY_LANE(sqrt_, std::sqrt(x))
BY_LANE(exp_, std::exp(x))
BY_LANE(expm1_, std::expm1(x))
BY_LANE(log_, std::log(x))
BY_LANE(tanh_, std::tanh(x))
BY_LANE(tan_, std::tan(x))
BY_LANE(asin_, std::asin(x))
BY_LANE(acos_, std::acos(x))
BY_LANE(atan_, std::atan(x))
BY_LANE(floor_, std::floor(x))

static inline V atan2_(V a, V b) {
    for (int w = 0; w < LANES; ++w) lane(a, w) = std::atan2(lane(a, w), lane(b, w));
    return a;
}
static inline V pow_(V a, V b) {
    for (int w = 0; w < LANES; ++w) lane(a, w) = std::pow(lane(a, w), lane(b, w));
    return a;
}

// sin and cos by reduction to [-pi/4, pi/4] and the polynomials of fdlibm (double) and Cephes (float), for all lanes at
// once; for an angle beyond the reduction's reach the library is asked.
static inline V quadrant(V x) { return (x * (REAL)0.63661977236758134308 + ROUND) - ROUND; }

template <int shift>
static inline V sine(V x, V n) {
    V y, r, sine, cosine;
    if (sizeof(REAL) == 8) {
        y = ((x - n * (REAL)1.57079632673412561417e+00) - n * (REAL)6.07710050630396597660e-11) -
            n * (REAL)2.02226624879595063154e-21;
        r = y * y;
        sine = y + y * r * ((REAL)-1.66666666666666324348e-01 + r * ((REAL)8.33333333332248946124e-03 +
               r * ((REAL)-1.98412698298579493134e-04 + r * ((REAL)2.75573137070700676789e-06 +
               r * ((REAL)-2.50507602534068634195e-08 + r * (REAL)1.58969099521155010221e-10)))));
        cosine = (REAL)1 - (REAL)0.5 * r + r * r * ((REAL)4.16666666666666019037e-02 +
                 r * ((REAL)-1.38888888888741095749e-03 + r * ((REAL)2.48015872894767294178e-05 +
                 r * ((REAL)-2.75573143513906633035e-07 + r * ((REAL)2.08757232129817482790e-09 +
                 r * (REAL)-1.13596475577881948265e-11)))));
    } else {
        y = ((x - n * (REAL)1.5703125) - n * (REAL)4.837512969970703125e-4) - n * (REAL)7.549789954891882e-8;
        r = y * y;
        sine = y + y * r * ((REAL)-1.6666654611e-1 + r * ((REAL)8.3321608736e-3 + r * (REAL)-1.9515295891e-4));
        cosine = (REAL)1 - (REAL)0.5 * r + r * r * ((REAL)4.166664568298827e-2 +
                 r * ((REAL)-1.388731625493765e-3 + r * (REAL)2.443315711809948e-5));
    }
    I k = integer(n) + shift;
    V chosen = (k & 1) == 0 ? sine : cosine;
    return (k & 2) == 0 ? chosen : -chosen;
}
// Only the lanes out of reach: a row's result does not depend on its neighbours, not even in its last bit.
#define WITHIN_REACH(name, shift, exact)                                       \
    static inline V name(V x) {                                                \
        V y = sine<shift>(x, quadrant(x));                                     \
        if (__builtin_expect(any(abs_(x) >= (REAL)REACH), 0))                  \
            for (int w = 0; w < LANES; ++w)                                    \
                if (std::fabs(lane(x, w)) >= (REAL)REACH) lane(y, w) = exact(lane(x, w)); \
        return y;                                                              \
    }
WITHIN_REACH(sin_, 0, std::sin)
WITHIN_REACH(cos_, 1, std::cos)
