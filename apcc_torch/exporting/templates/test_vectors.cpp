// @origin@
// Compares the library with steps of the Python controller. Exits with 0 where all are alike.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#include "@name@.hpp"
#include "vectors.hpp"

extern "C" int header_is_c(void);

static int allocations = 0;
#ifdef COUNT_ALLOCATIONS
extern "C" {
void* __real_malloc(std::size_t);
void* __real_calloc(std::size_t, std::size_t);
void* __real_realloc(void*, std::size_t);
void* __wrap_malloc(std::size_t size) { return ++allocations, __real_malloc(size); }
void* __wrap_calloc(std::size_t n, std::size_t size) { return ++allocations, __real_calloc(n, size); }
void* __wrap_realloc(void* old, std::size_t size) { return ++allocations, __real_realloc(old, size); }
}
#endif

static const double tolerance = @tolerance@;
static int failures = 0;
static double worst = 0.0;
static int at_step = 0;

static void differ(const char* what, double have, double want) {
    if (++failures <= 10) std::printf("step %d: %s is %.17g, not %.17g\n", at_step, what, have, want);
}

template <class T>
static void compare(const char* what, const void* have, const void* want, int n, T) {
    for (int i = 0; i < n; ++i) {
        T a, b;
        std::memcpy(&a, static_cast<const char*>(have) + i * sizeof a, sizeof a);
        std::memcpy(&b, static_cast<const char*>(want) + i * sizeof b, sizeof b);
        const double x = static_cast<double>(a), y = static_cast<double>(b);
        if (x == y || (std::isnan(x) && std::isnan(y))) continue;
        const double off = std::fabs(x - y) / std::fmax(1.0, std::fabs(y));
        if (!(off <= tolerance)) differ(what, x, y);
        worst = std::fmax(worst, off);
    }
}

// Of arrays of any dimension: the type of their entries.
template <class T> struct Entry { using type = T; };
template <class T, std::size_t n> struct Entry<T[n]> : Entry<T> {};
template <class T>
static void compare(const char* what, const T* have, const T* want, int n) {
    compare(what, have, want, n, typename Entry<T>::type{});
}

int main() {
    @name@::Controller controller;
    const int before = allocations;
    for (at_step = 0; at_step < steps; ++at_step) {
        const @name@_command &have = controller.step(measurements[at_step], targets[at_step]), &want = commands[at_step];
@compared@
    }
// @if covariance@
    {
        const @name@_uncertainty have = controller.uncertainty(measurements[steps - 1]), &want = uncertaintys[0];
@compared_uncertainty@
    }
// @end@
    const int allocated = allocations - before;
    if (allocated && !failures) ++failures;
    if (!header_is_c()) ++failures;
    std::printf("%d steps, %d failures, largest difference %.3g, %d allocations\n", steps, failures, worst, allocated);
    return failures ? EXIT_FAILURE : EXIT_SUCCESS;
}
