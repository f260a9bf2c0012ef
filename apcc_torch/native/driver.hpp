// Loads rows into lanes, runs the parts of the program, and stores what comes out. The words between @ are filled in.
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
