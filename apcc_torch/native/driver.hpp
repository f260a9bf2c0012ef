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

// After so many microseconds between two calls; and how far the last part reaches, bytes.
#define PAUSE 500
#define LAST 16384

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

#if LANES == 1
// After a pause the code lies far from the processor, and fetching it as it runs takes longer than to run it. Asked for
// beforehand it comes in one stream.
static void woken() {
    static std::atomic<long long> last{0};
    const long long now =
        std::chrono::duration_cast<std::chrono::microseconds>(std::chrono::steady_clock::now().time_since_epoch()).count();
    if (now - last.exchange(now, std::memory_order_relaxed) < PAUSE) return;
    const char* const parts[] = {@PARTS@};
    const char *first = parts[0], *end = parts[0];
    for (const char* part : parts) {
        if (part < first) first = part;
        if (part > end) end = part;
    }
    for (const char* line = first; line < end + LAST; line += 64) __builtin_prefetch(line, 0, 2);
}
#else
static void woken() {}
#endif

extern "C" void run(long rows, long repeats, int threads, const REAL* numbers, void** inputs, const long* stride,
                    void** outputs) {
    woken();
    const long count = (rows + LANES - 1) / LANES;
    if (threads > count) threads = (int)count;
    std::vector<std::thread> others;
    for (int t = 1; t < threads; ++t)
        others.emplace_back(blocks, count * t / threads, count * (t + 1) / threads, rows, repeats, numbers, inputs,
                            stride, outputs);
    blocks(0, threads > 1 ? count / threads : count, rows, repeats, numbers, inputs, stride, outputs);
    for (auto& thread : others) thread.join();
}
