// Copies before and after the one-dimensional transforms of a slab. Each function reads and writes the memory once.
// tests/kernels/test_copies.py compares them with numpy. Complex numbers are real and imaginary part, one after the
// other.

#include <cstdint>
#include <vector>

extern "C" {

// Blocks (components, planes, lines, width) of complex numbers that ranks exchange. The block of rank r holds the
// planes or the lines starts[r] ... starts[r + 1] - 1. kernels/copies.py has the same structure.
struct Blocks {
    std::int64_t ranks, planes, lines, width;  // along the cut axis, the length over all ranks
    void* const* addresses;                    // (ranks)
    const std::int64_t* starts;                // (ranks + 1)
};

}  // extern "C"

namespace {

using Int = std::int64_t;

constexpr Int FEW = 1 << 14;  // with fewer complex numbers, one thread is used

// Addresses of the lines of a plane, for blocks that are cut along lines.
template <typename Real>
void find_lines(const Blocks& blocks, Int component, Int plane, Real** lines) {
    for (Int rank = 0; rank < blocks.ranks; ++rank) {
        const Int start = blocks.starts[rank], count = blocks.starts[rank + 1] - start;
        Real* line = static_cast<Real*>(blocks.addresses[rank]) +
                     2 * (component * blocks.planes + plane) * count * blocks.width;
        for (Int y = start; y < start + count; ++y, line += 2 * blocks.width) lines[y] = line;
    }
}

// Addresses of all planes, for blocks that are cut along planes.
template <typename Real>
void find_planes(const Blocks& blocks, Int component, Real** planes) {
    const Int plane = 2 * blocks.lines * blocks.width;
    for (Int rank = 0; rank < blocks.ranks; ++rank) {
        const Int start = blocks.starts[rank], count = blocks.starts[rank + 1] - start;
        Real* first = static_cast<Real*>(blocks.addresses[rank]) + component * count * plane;
        for (Int z = start; z < start + count; ++z) planes[z] = first + (z - start) * plane;
    }
}

template <typename Real>
inline void copy(const Real* __restrict from, Real* __restrict to, Int count) {
#pragma omp simd
    for (Int i = 0; i < 2 * count; ++i) to[i] = from[i];
}

template <typename Real>
inline void times(const Real* __restrict from, Real real, Real imaginary, Real* __restrict to, Int count) {
#pragma omp simd
    for (Int i = 0; i < count; ++i) {
        const Real a = from[2 * i], b = from[2 * i + 1];
        to[2 * i] = real * a - imaginary * b;
        to[2 * i + 1] = real * b + imaginary * a;
    }
}

template <typename Real>
inline void times(const Real* __restrict from, const Real* __restrict factors, Real* __restrict to, Int count) {
#pragma omp simd
    for (Int i = 0; i < count; ++i) {
        const Real a = from[2 * i], b = from[2 * i + 1], c = factors[2 * i], d = factors[2 * i + 1];
        to[2 * i] = c * a - d * b;
        to[2 * i + 1] = c * b + d * a;
    }
}

template <typename Real>
void pack(const Blocks& blocks, Int components, Int first, Int planes, Real* packed) {
    const Int K = blocks.width - 1, lines = 2 * K + 1, pairs = (planes + 1) / 2;
#pragma omp parallel if (components * pairs * lines * lines > FEW)
    {
        std::vector<Real*> f(lines), g(lines);
#pragma omp for schedule(static)
        for (Int pair = 0; pair < components * pairs; ++pair) {
            const Int plane = first + pair % pairs;
            find_lines(blocks, pair / pairs, plane, f.data());
            find_lines(blocks, pair / pairs, plane + planes - pairs, g.data());
            for (Int y = 0; y < lines; ++y) {
                const Int turned = y ? lines - y : 0;
                const Real *__restrict p = f[y], *__restrict q = g[y], *__restrict r = f[turned],
                                       *__restrict s = g[turned];
                Real* __restrict line = packed + 2 * (pair * lines + y) * lines;
                line[0] = Real(0.5) * (p[0] + r[0] - q[1] + s[1]);
                line[1] = Real(0.5) * (p[1] - r[1] + q[0] + s[0]);
#pragma omp simd
                for (Int x = 1; x <= K; ++x) {
                    line[2 * x] = p[2 * x] - q[2 * x + 1];
                    line[2 * x + 1] = p[2 * x + 1] + q[2 * x];
                }
                line += 2 * (K + 1);
#pragma omp simd
                for (Int x = 0; x < K; ++x) {
                    const Int from = 2 * (K - x);
                    line[2 * x] = r[from] + s[from + 1];
                    line[2 * x + 1] = s[from] - r[from + 1];
                }
            }
        }
    }
}

template <typename Real>
void unpack(const Blocks& blocks, Int component, Int first, Int planes, const Real* rows, Int cells, Int width) {
    const Int K = blocks.width - 1, lines = 2 * K + 1, pairs = (planes + 1) / 2;
    std::vector<Real*> addresses(2 * pairs * lines);
    for (Int plane = 0; plane < planes; ++plane)
        find_lines(blocks, component, first + plane, addresses.data() + plane * lines);
#pragma omp parallel for schedule(static) if (pairs * lines * lines > FEW)
    for (Int line = 0; line < pairs * lines; ++line) {
        const Int pair = line / lines, y = line % lines;
        const Real* plane = rows + 2 * pair * cells * width;
        const Real* __restrict p = plane + 2 * (y <= K ? y : cells - lines + y) * width;
        const Int turned = y == 0 ? 0 : (y <= K ? cells - y : lines - y);
        const Real* __restrict m = plane + 2 * turned * width;
        Real* __restrict f = addresses[line];
        const bool alone = pair + pairs >= planes;
        f[0] = p[0] + m[0];
        f[1] = p[1] - m[1];
#pragma omp simd
        for (Int x = 1; x <= K; ++x) {
            f[2 * x] = p[2 * x] + m[2 * (width - x)];
            f[2 * x + 1] = p[2 * x + 1] - m[2 * (width - x) + 1];
        }
        if (alone) continue;
        Real* __restrict g = addresses[line + pairs * lines];
        g[0] = p[1] + m[1];
        g[1] = m[0] - p[0];
#pragma omp simd
        for (Int x = 1; x <= K; ++x) {
            g[2 * x] = p[2 * x + 1] + m[2 * (width - x) + 1];
            g[2 * x + 1] = m[2 * (width - x)] - p[2 * x];
        }
    }
}

template <typename Real>
void fill(Int pairs, Int K, Int cells, Int width, const Real* packed, const Real* by_y, const Real* by_x, Real* rows) {
    const Int lines = 2 * K + 1;
#pragma omp parallel for schedule(static) if (pairs * lines * lines > FEW)
    for (Int line = 0; line < pairs * lines; ++line) {
        const Int y = line % lines;
        const Real* from = packed + 2 * line * lines;
        Real* to = rows + 2 * (line / lines * cells + (y <= K ? y : cells - lines + y)) * width;
        Real* end = to + 2 * (width - K);
        if (by_y) {
            times(from, by_y[2 * y], by_y[2 * y + 1], to, K + 1);
            times(from + 2 * (K + 1), by_y[2 * y], by_y[2 * y + 1], end, K);
        } else if (by_x) {
            times(from, by_x, to, K + 1);
            times(from + 2 * (K + 1), by_x + 2 * (K + 1), end, K);
        } else {
            copy(from, to, K + 1);
            copy(from + 2 * (K + 1), end, K);
        }
    }
}

// The complex planes (pairs, y, x) hold f + i g; the real planes of f, and those of g, follow each other in memory.
template <typename Real>
void split(Int points, const Real* __restrict planes, Real* __restrict f, Real* __restrict g) {
#pragma omp parallel for simd schedule(static) if (parallel : points > FEW)
    for (Int i = 0; i < points; ++i) {
        f[i] = planes[2 * i];
        g[i] = planes[2 * i + 1];
    }
}

template <typename Real>
void join(Int points, const Real* __restrict f, const Real* __restrict g, Real* __restrict planes) {
#pragma omp parallel for simd schedule(static) if (parallel : points > FEW)
    for (Int i = 0; i < points; ++i) {
        planes[2 * i] = f[i];
        planes[2 * i + 1] = g[i];
    }
}

// Copy some lines of modes (kz, lines, width) to a column (cells, some lines, width) whose kept modes lie at both ends
// of z. Successive z of the column are `apart` complex numbers from each other.
template <typename Real>
void fill_column(Int K, Int cells, Int plane, Int count, Int apart, const Real* modes, const Real* factors,
                 Real* column) {
    const Int kept = 2 * K + 1;
#pragma omp parallel for schedule(static) if (kept * count > FEW)
    for (Int z = 0; z < kept; ++z) {
        Real* to = column + 2 * (z <= K ? z : cells - kept + z) * apart;
        if (factors) times(modes + 2 * z * plane, factors[2 * z], factors[2 * z + 1], to, count);
        else copy(modes + 2 * z * plane, to, count);
    }
}

template <typename Real>
void store_column(Int K, Int cells, Int plane, Int count, Int apart, const Real* column, Real scale, Real* modes) {
    const Int kept = 2 * K + 1;
#pragma omp parallel for schedule(static) if (kept * count > FEW)
    for (Int z = 0; z < kept; ++z) {
        const Real* __restrict from = column + 2 * (z <= K ? z : cells - kept + z) * apart;
        Real* __restrict to = modes + 2 * z * plane;
#pragma omp simd
        for (Int i = 0; i < 2 * count; ++i) to[i] = scale * from[i];
    }
}

template <typename Real, bool send>
void exchange_column(const Blocks& blocks, Int component, Int line, Int lines, Int apart, Real* column) {
    std::vector<Real*> planes(blocks.planes);
    find_planes(blocks, component, planes.data());
    const Int count = lines * blocks.width;
#pragma omp parallel for schedule(static) if (blocks.planes * count > FEW)
    for (Int z = 0; z < blocks.planes; ++z) {
        Real *own = column + 2 * z * apart, *block = planes[z] + 2 * line * blocks.width;
        if (send) copy(own, block, count);
        else copy(block, own, count);
    }
}

}  // namespace

// All functions for one precision, as kernels/copies.py calls them.
#define COPIES(Real, precision)                                                                                       \
    void copies_pack_##precision(const Blocks* blocks, Int components, Int first, Int planes, Real* packed) {         \
        pack(*blocks, components, first, planes, packed);                                                             \
    }                                                                                                                 \
    void copies_unpack_##precision(const Blocks* blocks, Int component, Int first, Int planes, Int cells, Int width,  \
                                   const Real* rows) {                                                                \
        unpack(*blocks, component, first, planes, rows, cells, width);                                                \
    }                                                                                                                 \
    void copies_fill_##precision(Int pairs, Int K, Int cells, Int width, const Real* packed, const Real* by_y,        \
                                 const Real* by_x, Real* rows) {                                                      \
        fill(pairs, K, cells, width, packed, by_y, by_x, rows);                                                       \
    }                                                                                                                 \
    void copies_split_##precision(Int points, const Real* planes, Real* f, Real* g) { split(points, planes, f, g); }  \
    void copies_join_##precision(Int points, const Real* f, const Real* g, Real* planes) {                            \
        join(points, f, g, planes);                                                                                   \
    }                                                                                                                 \
    void copies_fill_column_##precision(Int K, Int cells, Int plane, Int count, Int apart, const Real* modes,         \
                                        const Real* factors, Real* column) {                                          \
        fill_column(K, cells, plane, count, apart, modes, factors, column);                                           \
    }                                                                                                                 \
    void copies_store_column_##precision(Int K, Int cells, Int plane, Int count, Int apart, const Real* column,       \
                                         double scale, Real* modes) {                                                 \
        store_column(K, cells, plane, count, apart, column, static_cast<Real>(scale), modes);                         \
    }                                                                                                                 \
    void copies_send_column_##precision(const Blocks* blocks, Int component, Int line, Int lines, Int apart,          \
                                        Real* column) {                                                               \
        exchange_column<Real, true>(*blocks, component, line, lines, apart, column);                                  \
    }                                                                                                                 \
    void copies_receive_column_##precision(const Blocks* blocks, Int component, Int line, Int lines, Int apart,       \
                                           Real* column) {                                                            \
        exchange_column<Real, false>(*blocks, component, line, lines, apart, column);                                 \
    }

extern "C" {

COPIES(double, float64)
COPIES(float, float32)

}  // extern "C"
