// Loads rows into lanes, runs the parts of the program, and stores what comes out. The words between @ are filled in.
template <class T> static inline void load(const T* from, long stride, int n, const long* row, V* to) {
    for (int w = 0; w < LANES; ++w)
        for (int i = 0; i < n; ++i) lane(to[i], w) = (REAL)from[row[w] * stride + i];
}
template <class T> static inline void load_int(const T* from, long stride, int n, const long* row, I* to) {
    for (int w = 0; w < LANES; ++w)
        for (int i = 0; i < n; ++i) lane_int(to[i], w) = (INTEGER)from[row[w] * stride + i];
}
template <class T> static inline void load_bool(const T* from, long stride, int n, const long* row, B* to) {
    for (int i = 0; i < n; ++i) {
        I x;
        for (int w = 0; w < LANES; ++w) lane_int(x, w) = from[row[w] * stride + i];
        to[i] = x != splat_int(0);
    }
}
template <class T> static inline void store(T* to, long stride, int n, const long* row, V* from) {
    for (int w = 0; w < LANES; ++w)
        for (int i = 0; i < n; ++i) to[row[w] * stride + i] = (T)lane(from[i], w);
}
template <class T> static inline void store_int(T* to, long stride, int n, const long* row, I* from) {
    for (int w = 0; w < LANES; ++w)
        for (int i = 0; i < n; ++i) to[row[w] * stride + i] = (T)lane_int(from[i], w);
}
template <class T> static inline void store_bool(T* to, long stride, int n, const long* row, B* from) {
    for (int i = 0; i < n; ++i) {
        I x = from[i] ? splat_int(1) : splat_int(0);
        for (int w = 0; w < LANES; ++w) to[row[w] * stride + i] = (T)lane_int(x, w);
    }
}

static void blocks(long first, long last, long rows, long repeats, const REAL* numbers, void** inputs,
                   const long* stride, void** outputs) {
    Inputs in;
    Scratch s;
    Outputs out;
    for (long block = first; block < last; ++block) {
        // The last block's spare lanes repeat the last row.
        long row[LANES];
        for (int w = 0; w < LANES; ++w) row[w] = block * LANES + w < rows ? block * LANES + w : rows - 1;
        @LOADS@
        for (long k = 0; k < repeats; ++k) {
            if (k) { @CARRY@ }
            @CALLS@
        }
        @STORES@
    }
}

extern "C" void run(long rows, long repeats, int threads, const REAL* numbers, void** inputs, const long* stride,
                    void** outputs) {
    const long count = (rows + LANES - 1) / LANES;
    if (threads > count) threads = (int)count;
    std::vector<std::thread> others;
    for (int t = 1; t < threads; ++t)
        others.emplace_back(blocks, count * t / threads, count * (t + 1) / threads, rows, repeats, numbers, inputs,
                            stride, outputs);
    blocks(0, threads > 1 ? count / threads : count, rows, repeats, numbers, inputs, stride, outputs);
    for (auto& thread : others) thread.join();
}
