// Takes rows of tensors, each of n entries side by side, to lanes and back: entry i of every row is one vector. Whole
// vectors are read and written, and turned in registers; one by one, entries cost more than what is computed with them.
// `row` names the rows, in order; the last block's spare lanes repeat the last row.
#if LANES > 1 && defined(__has_builtin)
#if __has_builtin(__builtin_shufflevector)
#define TURNED
#endif
#endif

#ifdef TURNED
#include <utility>

// Of fewer entries a turn would be for the most part of nothing.
#define LEAST (LANES / 2)

template <int half, int... w> static inline void exchanged(V& a, V& b, std::integer_sequence<int, w...>) {
    const V low = __builtin_shufflevector(a, b, (w & half ? LANES + w - half : w)...);
    b = __builtin_shufflevector(a, b, (w & half ? LANES + w : w + half)...);
    a = low;
}
// LANES vectors become their transpose: halves change places, then halves of these.
template <int half> static inline void turned(V* r) {
#pragma GCC unroll 16
    for (int i = 0; i < LANES; ++i)
        if (!(i & half)) exchanged<half>(r[i], r[i + half], std::make_integer_sequence<int, LANES>());
    if constexpr (half > 1) turned<half / 2>(r);
}
// `count` entries from the c-th on; a vector may reach into the next rows, but not beyond the last.
template <int n, int count> static inline void load_turned(const REAL* from, const long* row, long rows, int c, V* to) {
    V r[LANES];
    if (count == LANES || (row[LANES - 1] + 1) * n + LANES <= rows * n)
#pragma GCC unroll 16
        for (int w = 0; w < LANES; ++w) std::memcpy(&r[w], from + row[w] * n + c, sizeof(V));
    else
        for (int w = 0; w < LANES; ++w)
            for (int i = 0; i < count; ++i) lane(r[w], i) = from[row[w] * n + c + i];
    turned<LANES / 2>(r);
#pragma GCC unroll 16
    for (int i = 0; i < count; ++i) to[c + i] = r[i];
}
// What a vector leaves in the next row is written over, by the next row or by what comes before in it. But beyond this
// block's rows another thread may write.
template <int n, int count> static inline void store_turned(REAL* to, const long* row, int c, const V* from) {
    V r[LANES];
#pragma GCC unroll 16
    for (int i = 0; i < LANES; ++i) r[i] = from[c + (i < count ? i : 0)];
    turned<LANES / 2>(r);
#pragma GCC unroll 16
    for (int w = 0; w < LANES; ++w)
        if (count == LANES || row[w] < row[LANES - 1]) std::memcpy(to + row[w] * n + c, &r[w], sizeof(V));
        else
            for (int i = 0; i < count; ++i) to[row[w] * n + c + i] = lane(r[w], i);
}
#endif

template <int n, class T> static inline void load(const T* from, long stride, const long* row, long rows, V* to) {
    if (stride == 0) {
        for (int i = 0; i < n; ++i) to[i] = splat((REAL)from[i]);
        return;
    }
    int done = 0;
#ifdef TURNED
    if constexpr (std::is_same<T, REAL>::value) {
        constexpr int rest = n % LANES;
        for (; done < n - rest; done += LANES) load_turned<n, LANES>(from, row, rows, done, to);
        if constexpr (rest >= LEAST) {
            load_turned<n, rest>(from, row, rows, done, to);
            return;
        }
    }
#endif
    for (int w = 0; w < LANES; ++w)
        for (int i = done; i < n; ++i) lane(to[i], w) = (REAL)from[row[w] * stride + i];
}
template <int n, class T> static inline void load_int(const T* from, long stride, const long* row, long, I* to) {
    for (int w = 0; w < LANES; ++w)
        for (int i = 0; i < n; ++i) lane_int(to[i], w) = (INTEGER)from[row[w] * stride + i];
}
template <int n, class T> static inline void load_bool(const T* from, long stride, const long* row, long, B* to) {
    for (int i = 0; i < n; ++i) {
        I x;
        for (int w = 0; w < LANES; ++w) lane_int(x, w) = from[row[w] * stride + i];
        to[i] = x != splat_int(0);
    }
}
template <int n, class T> static inline void store(T* to, const long* row, V* from) {
    int done = 0;
#ifdef TURNED
    if constexpr (std::is_same<T, REAL>::value) {
        constexpr int rest = n % LANES;
        if constexpr (rest >= LEAST) store_turned<n, rest>(to, row, n - rest, from);
        for (; done < n - rest; done += LANES) store_turned<n, LANES>(to, row, done, from);
        if constexpr (rest >= LEAST) return;
    }
#endif
    for (int w = 0; w < LANES; ++w)
        for (int i = done; i < n; ++i) to[row[w] * n + i] = (T)lane(from[i], w);
}
template <int n, class T> static inline void store_int(T* to, const long* row, I* from) {
    for (int w = 0; w < LANES; ++w)
        for (int i = 0; i < n; ++i) to[row[w] * n + i] = (T)lane_int(from[i], w);
}
template <int n, class T> static inline void store_bool(T* to, const long* row, B* from) {
    for (int i = 0; i < n; ++i) {
        I x = from[i] ? splat_int(1) : splat_int(0);
        for (int w = 0; w < LANES; ++w) to[row[w] * n + i] = (T)lane_int(x, w);
    }
}
