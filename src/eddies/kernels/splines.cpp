// Tensor-product B-splines between points and the planes of a periodic grid.
//
// Points are sorted into bins once. The grid points around a bin are copied to a tile that fits the first-level cache
// of a core; the components of a grid point are neighbours there. Spread values are added to the tile first. The
// weights of the splines are computed in each call from the points' fractions of a cell, which costs less than storing
// them. Results do not depend on the number of threads: one thread sums a value, and points add to a plane in a fixed
// order.

#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

extern "C" {

// Points in order of place, as `splines_arrange` makes it; kernels/splines.py has the same structure.
//
// The splines around a point begin at the column, line and plane `first`, which is (degree - 1)/2 before its cell; the
// point is at `fraction` of the cell.
struct Cloud {
    std::int64_t points, cells, planes, degree;
    std::int32_t* order;   // (points), rows of the caller's arrays
    std::int32_t* first;   // (points, 3)
    double* fraction;      // (3, points + 8)
    std::int64_t* starts;  // (bins + 1), where the points of each bin begin
};

}  // extern "C"

namespace {

constexpr int LINES = 16, PLANES = 8, COLUMNS = 8;  // largest size of a bin
constexpr int TOGETHER = 4;        // components in a tile
constexpr int PADDING = 8;         // numbers after the fractions along an axis that may be read
constexpr int FEW = 2000;          // points below which one thread is used
constexpr double FARTHEST = 1e15;  // in cells; beyond, floating-point numbers do not resolve a cell

// The grid is cut into chunks of lines, each chunk into layers of planes, and each layer into strips of columns, which
// are the bins. All bins are about equally large. There is one chunk or an even number of chunks. Chunks are so long
// that the splines of two chunks have no line in common if another chunk is between them.
struct Bins {
    std::int64_t chunks, layers, strips;

    Bins(std::int64_t cells, std::int64_t planes)
        : chunks(cells < LINES ? 1 : cells / LINES * 2), layers((planes - 1) / PLANES + 1),
          strips((cells - 1) / COLUMNS + 1) {}

    explicit Bins(const Cloud& cloud) : Bins(cloud.cells, cloud.planes) {}

    std::int64_t of_a_chunk() const { return layers * strips; }
    std::int64_t all() const { return chunks * of_a_chunk(); }
};

template <typename Vector, typename Real>
inline Vector loaded(const Real* place) {
    Vector vector;
    std::memcpy(&vector, place, sizeof(vector));
    return vector;
}

// `Point` holds the components at one grid point. `Wide`, of 32 bytes, holds those at one or two successive points.
template <typename Real>
struct Vectors;

template <>
struct Vectors<float> {
    using Point = float __attribute__((vector_size(16)));
    using Places = std::int32_t __attribute__((vector_size(16)));
    using Wide = float __attribute__((vector_size(32)));
    static constexpr int neighbours = 2;
    static Wide factors(const float* x) { return Wide{x[0], x[0], x[0], x[0], x[8], x[8], x[8], x[8]}; }
    static Point sum(const Wide& v) { return Point{v[0], v[1], v[2], v[3]} + Point{v[4], v[5], v[6], v[7]}; }
    static Wide rounded(const double* values) {
        using Eight = double __attribute__((vector_size(64)));
        return __builtin_convertvector(loaded<Eight>(values), Wide);
    }
};

template <>
struct Vectors<double> {
    using Point = double __attribute__((vector_size(32)));
    using Places = std::int64_t __attribute__((vector_size(32)));
    using Wide = Point;
    static constexpr int neighbours = 1;
    static Wide factors(const double* x) { return Wide{x[0], x[0], x[0], x[0]}; }
    static Point sum(const Wide& v) { return v; }
    static Wide rounded(const double* values) { return loaded<Wide>(values); }
};

template <typename Vector, typename Real>
inline void store(Real* place, const Vector& vector) {
    std::memcpy(place, &vector, sizeof(vector));
}

// Numbers of the vectors a and b by their places: 0 to 3 are those of a, 4 to 7 those of b.
#ifdef __clang__
#define PICKED(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define PICKED(a, b, ...) __builtin_shuffle(a, b, typename Vectors<Real>::Places{__VA_ARGS__})
#endif

// Transpose of four vectors of four numbers.
template <typename Real>
inline void transpose(typename Vectors<Real>::Point* rows) {
    using Point = typename Vectors<Real>::Point;
    const Point a = PICKED(rows[0], rows[1], 0, 4, 1, 5), b = PICKED(rows[0], rows[1], 2, 6, 3, 7);
    const Point c = PICKED(rows[2], rows[3], 0, 4, 1, 5), d = PICKED(rows[2], rows[3], 2, 6, 3, 7);
    rows[0] = PICKED(a, c, 0, 1, 4, 5);
    rows[1] = PICKED(a, c, 2, 3, 6, 7);
    rows[2] = PICKED(b, d, 0, 1, 4, 5);
    rows[3] = PICKED(b, d, 2, 3, 6, 7);
}

template <typename Real>
inline Real sum(const typename Vectors<Real>::Point& point) {
    return (point[0] + point[2]) + (point[1] + point[3]);
}

// Points whose splines are computed together.
template <typename Real>
constexpr int BLOCK = 32 / sizeof(Real);
template <typename Real>
using Numbers = Real[BLOCK<Real>];

// Splines of one degree along one axis.
template <int degree, typename Real>
struct Weights {
    using Wide = typename Vectors<Real>::Wide;
    Wide values[degree + 1];

    // By the recursion of de Boor on uniform knots.
    explicit Weights(const Wide& fraction) {
        values[0] = Wide{} + 1;
#pragma GCC unroll 5
        for (int order = 1; order <= degree; ++order) {
            const Real share = Real(1) / order;
            Wide carried = {};
#pragma GCC unroll 5
            for (int i = 0; i < order; ++i) {
                // Distance of the point from the left end of each of the overlapping splines.
                const Wide left = fraction + Real(order - 1 - i), weight = values[i] * share;
                values[i] = carried + weight * (Real(order) - left);
                carried = weight * left;
            }
            values[order] = carried;
        }
    }

    // The derivatives with respect to the fraction, which are differences of splines of the next lower degree.
    static Weights slopes(const Wide& fraction) {
        const Weights<degree - 1, Real> lower(fraction);
        Weights result(fraction);
        result.values[0] = -lower.values[0];
        for (int i = 1; i < degree; ++i) result.values[i] = lower.values[i - 1] - lower.values[i];
        result.values[degree] = lower.values[degree - 1];
        return result;
    }

    void store_to(Numbers<Real>* places) const {
        for (int i = 0; i <= degree; ++i) store(places[i], values[i]);
    }

    // Weights across lines: those of the planes times those of the lines.
    static void multiply(const Weights& z, const Weights& y, Numbers<Real> (*across)[degree + 1]) {
        for (int k = 0; k <= degree; ++k)
            for (int j = 0; j <= degree; ++j) store(across[k][j], z.values[k] * y.values[j]);
    }
};

// Points from `begin` on and the weights of the splines around them.
template <int degree, typename Real>
struct Block {
    static constexpr int width = degree + 1;
    using Wide = typename Vectors<Real>::Wide;
    int count;
    Wide fraction[3];
    alignas(64) Numbers<Real> along_x[width], across[width][width];

    Block(const Cloud& cloud, std::int64_t begin, std::int64_t end)
        : count(static_cast<int>(end - begin < BLOCK<Real> ? end - begin : BLOCK<Real>)) {
        for (int axis = 0; axis < 3; ++axis)
            fraction[axis] = Vectors<Real>::rounded(cloud.fraction + axis * (cloud.points + PADDING) + begin);
        Weights<degree, Real>(fraction[0]).store_to(along_x);
        using W = Weights<degree, Real>;
        W::multiply(W(fraction[2]), W(fraction[1]), across);
    }
};

// The grid points around a bin, each with the components of up to four fields.
template <int degree, typename Real>
struct Tile {
    using Point = typename Vectors<Real>::Point;
    static constexpr int columns = (COLUMNS + degree + TOGETHER - 1) / TOGETHER * TOGETHER;
    static constexpr int row = TOGETHER * columns, plane = (LINES + degree) * row;
    const Cloud& cloud;
    std::int64_t begin, end, lowest[3];
    int size[3];
    bool cut;  // whether the box ends within the tile
    std::int64_t starts[LINES + degree];  // of lines in a plane
    alignas(64) Real numbers[(PLANES + degree) * plane];

    Tile(const Cloud& cloud, std::int64_t bin) : cloud(cloud), begin(cloud.starts[bin]), end(cloud.starts[bin + 1]) {
        std::int64_t highest[3] = {-1, -1, -1};
        for (int axis = 0; axis < 3; ++axis) lowest[axis] = begin < end ? cloud.first[3 * begin + axis] : 0;
        for (std::int64_t p = begin; p < end; ++p)
            for (int axis = 0; axis < 3; ++axis) {
                const std::int64_t first = cloud.first[3 * p + axis];
                lowest[axis] = first < lowest[axis] ? first : lowest[axis];
                highest[axis] = first > highest[axis] ? first : highest[axis];
            }
        for (int axis = 0; axis < 3; ++axis) size[axis] = static_cast<int>(highest[axis] - lowest[axis]) + degree + 1;
        // Columns are moved in groups of four, if necessary with some that are not needed.
        const std::int64_t most = cloud.cells - (size[0] + TOGETHER - 1) / TOGETHER * TOGETHER;
        cut = most < 0 || lowest[0] + size[0] > cloud.cells;
        if (!cut) {
            size[0] = static_cast<int>(cloud.cells - most);
            lowest[0] = lowest[0] < most ? lowest[0] : most;
        }
        for (int j = 0; j < size[1]; ++j) starts[j] = (lowest[1] + j) % cloud.cells * cloud.cells;
    }

    // Address of the first grid point of a point's splines.
    Real* around(std::int64_t point) {
        const std::int32_t* first = cloud.first + 3 * point;
        return numbers + (first[2] - lowest[2]) * plane + (first[1] - lowest[1]) * row +
               (first[0] - lowest[0]) * TOGETHER;
    }

    void clear() {
        for (int k = 0; k < size[2]; ++k) std::memset(numbers + k * plane, 0, size[1] * row * sizeof(Real));
    }

    void read(const Real* const* planes, int components) {
        over_lines(planes, components, [&](const Real* const* lines, Real* line) {
            if (cut) {
                std::int64_t column = lowest[0];
                for (int i = 0; i < size[0]; ++i, column = column + 1 < cloud.cells ? column + 1 : 0)
                    for (int c = 0; c < TOGETHER; ++c) line[TOGETHER * i + c] = c < components ? lines[c][column] : 0;
                return;
            }
            for (int c = 0; c < components; ++c) __builtin_prefetch(lines[c] + lowest[0] + size[0] + COLUMNS);
            for (int i = 0; i < size[0]; i += TOGETHER) {
                Point points[TOGETHER];
#pragma GCC unroll 4
                for (int c = 0; c < TOGETHER; ++c)
                    points[c] = c < components ? loaded<Point>(lines[c] + lowest[0] + i) : Point{};
                transpose<Real>(points);
                for (int n = 0; n < TOGETHER; ++n) store(line + TOGETHER * (i + n), points[n]);
            }
        });
    }

    void add_to(Real* const* planes, int components) {
        over_lines(planes, components, [&](Real* const* lines, Real* line) {
            if (cut) {
                std::int64_t column = lowest[0];
                for (int i = 0; i < size[0]; ++i, column = column + 1 < cloud.cells ? column + 1 : 0)
                    for (int c = 0; c < components; ++c) lines[c][column] += line[TOGETHER * i + c];
                return;
            }
            for (int c = 0; c < components; ++c) __builtin_prefetch(lines[c] + lowest[0] + size[0] + COLUMNS, 1);
            for (int i = 0; i < size[0]; i += TOGETHER) {
                Point points[TOGETHER];
                for (int n = 0; n < TOGETHER; ++n) points[n] = loaded<Point>(line + TOGETHER * (i + n));
                transpose<Real>(points);
#pragma GCC unroll 4
                for (int c = 0; c < TOGETHER; ++c)
                    if (c < components) {
                        Real* place = lines[c] + lowest[0] + i;
                        store(place, loaded<Point>(place) + points[c]);
                    }
            }
        });
    }

  private:
    // Call function(the components' lines in memory, the line of the tile) for all lines of the tile.
    template <typename Pointer, typename Function>
    void over_lines(Pointer const* planes, int components, const Function& function) {
        for (int k = 0; k < size[2]; ++k)
            for (int j = 0; j < size[1]; ++j) {
                Pointer lines[TOGETHER];
                for (int c = 0; c < components; ++c)
                    lines[c] = planes[c * cloud.planes + lowest[2] + k] + starts[j];
                function(lines, numbers + k * plane + j * row);
            }
    }
};

// Call function(first component, number of components) for groups of components that fit a tile.
template <typename Function>
void by_components(std::int64_t components, const Function& function) {
    for (std::int64_t c = 0; c < components; c += TOGETHER)
        function(c, static_cast<int>(components - c < TOGETHER ? components - c : TOGETHER));
}

template <typename Real>
inline typename Vectors<Real>::Point point_of(const double* values, int components) {
    const auto value = [&](int c) { return static_cast<Real>(c < components ? values[c] : 0.0); };
    return typename Vectors<Real>::Point{value(0), value(1), value(2), value(3)};
}

template <int degree, typename Real>
void interpolate(const Cloud& cloud, std::int64_t components, const Real* const* planes, double* values) {
    using V = Vectors<Real>;
    using Wide = typename V::Wide;
    constexpr int width = degree + 1, wides = width / V::neighbours;
    const std::int64_t bins = Bins(cloud).all();
#pragma omp parallel for schedule(static) if (cloud.points > FEW)
    for (std::int64_t bin = 0; bin < bins; ++bin) {
        if (cloud.starts[bin] == cloud.starts[bin + 1]) continue;
        Tile<degree, Real> tile(cloud, bin);
        by_components(components, [&](std::int64_t c, int count) {
            tile.read(planes + c * cloud.planes, count);
            for (std::int64_t begin = tile.begin; begin < tile.end; begin += BLOCK<Real>) {
                const Block<degree, Real> block(cloud, begin, tile.end);
                for (int p = 0; p < block.count; ++p)
                    __builtin_prefetch(values + cloud.order[begin + p] * components + c, 1);
                for (int p = 0; p < block.count; ++p) {
                    const Real* around = tile.around(begin + p);
                    Wide sums[wides] = {};
                    for (int k = 0; k < width; ++k)
                        for (int j = 0; j < width; ++j)
                            for (int i = 0; i < wides; ++i)
                                sums[i] += block.across[k][j][p] * loaded<Wide>(around + k * tile.plane + j * tile.row +
                                                                                i * V::neighbours * TOGETHER);
                    Wide sum = {};
                    for (int i = 0; i < wides; ++i) sum += V::factors(&block.along_x[i * V::neighbours][p]) * sums[i];
                    const auto point = V::sum(sum);
                    double* value = values + cloud.order[begin + p] * components + c;
#pragma GCC unroll 4
                    for (int n = 0; n < TOGETHER; ++n)
                        if (n < count) value[n] = point[n];
                }
            }
        });
    }
}

template <int degree, typename Real>
void slope(const Cloud& cloud, std::int64_t components, const Real* const* planes, const double* factors,
           double* gradients) {
    using Point = typename Vectors<Real>::Point;
    constexpr int width = degree + 1;
    const std::int64_t bins = Bins(cloud).all();
#pragma omp parallel for schedule(static) if (cloud.points > FEW)
    for (std::int64_t bin = 0; bin < bins; ++bin) {
        if (cloud.starts[bin] == cloud.starts[bin + 1]) continue;
        Tile<degree, Real> tile(cloud, bin);
        for (std::int64_t p = tile.begin; p < tile.end; ++p)
            for (int axis = 0; axis < 3; ++axis) gradients[3 * cloud.order[p] + axis] = 0;
        by_components(components, [&](std::int64_t c, int count) {
            tile.read(planes + c * cloud.planes, count);
            for (std::int64_t begin = tile.begin; begin < tile.end; begin += BLOCK<Real>) {
                const Block<degree, Real> block(cloud, begin, tile.end);
                using W = Weights<degree, Real>;
                alignas(64) Numbers<Real> dx[width], dy[width][width], dz[width][width];
                W::slopes(block.fraction[0]).store_to(dx);
                W::multiply(W(block.fraction[2]), W::slopes(block.fraction[1]), dy);
                W::multiply(W::slopes(block.fraction[2]), W(block.fraction[1]), dz);
                for (int p = 0; p < block.count; ++p) {
                    const Real* around = tile.around(begin + p);
                    Point by_x{}, by_y{}, by_z{};
                    for (int i = 0; i < width; ++i) {
                        Point value{}, along_y{}, along_z{};
                        for (int k = 0; k < width; ++k)
                            for (int j = 0; j < width; ++j) {
                                const Point point =
                                    loaded<Point>(around + k * tile.plane + j * tile.row + i * TOGETHER);
                                value += block.across[k][j][p] * point;
                                along_y += dy[k][j][p] * point;
                                along_z += dz[k][j][p] * point;
                            }
                        by_x += dx[i][p] * value;
                        by_y += block.along_x[i][p] * along_y;
                        by_z += block.along_x[i][p] * along_z;
                    }
                    const std::int64_t row = cloud.order[begin + p];
                    const Point factor = point_of<Real>(factors + row * components + c, count);
                    gradients[3 * row] += sum<Real>(factor * by_x);
                    gradients[3 * row + 1] += sum<Real>(factor * by_y);
                    gradients[3 * row + 2] += sum<Real>(factor * by_z);
                }
            }
        });
    }
}

template <int degree, typename Real>
void spread_bin(const Cloud& cloud, std::int64_t bin, std::int64_t components, Real* const* planes,
                const double* values) {
    using Point = typename Vectors<Real>::Point;
    constexpr int width = degree + 1;
    Tile<degree, Real> tile(cloud, bin);
    by_components(components, [&](std::int64_t c, int count) {
        tile.clear();
        for (std::int64_t begin = tile.begin; begin < tile.end; begin += BLOCK<Real>) {
            for (std::int64_t p = begin + BLOCK<Real>; p < begin + 2 * BLOCK<Real> && p < cloud.points; ++p)
                __builtin_prefetch(values + cloud.order[p] * components + c);
            const Block<degree, Real> block(cloud, begin, tile.end);
            for (int p = 0; p < block.count; ++p) {
                const Point value = point_of<Real>(values + cloud.order[begin + p] * components + c, count);
                Real* around = tile.around(begin + p);
                Point points[width];
                for (int i = 0; i < width; ++i) points[i] = block.along_x[i][p] * value;
                for (int k = 0; k < width; ++k)
                    for (int j = 0; j < width; ++j)
                        for (int i = 0; i < width; ++i) {
                            Real* place = around + k * tile.plane + j * tile.row + i * TOGETHER;
                            store(place, loaded<Point>(place) + block.across[k][j][p] * points[i]);
                        }
            }
        }
        tile.add_to(planes + c * cloud.planes, count);
    });
}

template <int degree, typename Real>
void spread(const Cloud& cloud, std::int64_t components, Real* const* planes, const double* values) {
    const Bins bins(cloud);
    for (std::int64_t parity = 0; parity < 2; ++parity) {
#pragma omp parallel for schedule(dynamic, 1) if (cloud.points > FEW)
        for (std::int64_t chunk = parity; chunk < bins.chunks; chunk += 2)
            for (std::int64_t bin = chunk * bins.of_a_chunk(); bin < (chunk + 1) * bins.of_a_chunk(); ++bin)
                if (cloud.starts[bin] < cloud.starts[bin + 1])
                    spread_bin<degree, Real>(cloud, bin, components, planes, values);
    }
}

// For each of `size` places, the number of the part in which it lies. All parts are about equally long.
std::vector<std::int32_t> parts_of(std::int64_t size, std::int64_t parts) {
    std::vector<std::int32_t> part_of(size);
    for (std::int64_t part = 0; part < parts; ++part)
        for (std::int64_t i = part * size / parts; i < (part + 1) * size / parts; ++i)
            part_of[i] = static_cast<std::int32_t>(part);
    return part_of;
}

}  // namespace

extern "C" {

// Number of bins of a grid with these cells and planes.
int splines_bins(int cells, int planes) { return static_cast<int>(Bins(cells, planes).all()); }

// Fill the arrays of a cloud for points (n, 3) on a grid of this spacing whose plane `lowest` is the first in memory.
// Returns -1, or the number of the first point without a place there; the arrays are then incomplete.
std::int64_t splines_arrange(const Cloud* arranged, const double* positions, double spacing, std::int64_t lowest) {
    const Cloud& cloud = *arranged;
    const std::int64_t cells = cloud.cells, before = (cloud.degree - 1) / 2;
    const Bins bins(cloud);
    const std::vector<std::int32_t> strip = parts_of(cells, bins.strips), chunk = parts_of(cells, bins.chunks),
                                    layer = parts_of(cloud.planes, bins.layers);
    std::vector<std::int32_t> first(3 * cloud.points), bin_of(cloud.points);
    std::vector<std::int64_t> next(bins.all() + 1);
    std::int64_t misplaced = cloud.points;
#pragma omp parallel for schedule(static) reduction(min : misplaced) if (cloud.points > FEW)
    for (std::int64_t p = 0; p < cloud.points; ++p) {
        std::int32_t* place = &first[3 * p];
        bool placed = true;
        for (int axis = 0; axis < 3; ++axis) {
            const double cell = std::floor(positions[3 * p + axis] / spacing);
            placed = placed && std::abs(cell) < FARTHEST;  // false for NaN
            const std::int64_t index =
                placed ? (static_cast<std::int64_t>(cell) - before - (axis == 2 ? lowest : 0)) % cells : 0;
            place[axis] = static_cast<std::int32_t>(index < 0 ? index + cells : index);
        }
        if (placed && place[2] + cloud.degree < cloud.planes)
            bin_of[p] = static_cast<std::int32_t>(
                (chunk[place[1]] * bins.layers + layer[place[2]]) * bins.strips + strip[place[0]]);
        else if (p < misplaced) misplaced = p;
    }
    if (misplaced < cloud.points) return misplaced;
    for (std::int64_t p = 0; p < cloud.points; ++p) ++next[bin_of[p] + 1];
    for (std::int64_t bin = 0; bin < bins.all(); ++bin) next[bin + 1] += next[bin];
    std::memcpy(cloud.starts, next.data(), next.size() * sizeof(next[0]));
    for (std::int64_t p = 0; p < cloud.points; ++p) cloud.order[next[bin_of[p]]++] = static_cast<std::int32_t>(p);
#pragma omp parallel for schedule(static) if (cloud.points > FEW)
    for (std::int64_t p = 0; p < cloud.points; ++p)
        for (int axis = 0; axis < 3; ++axis) {
            const std::int64_t given = 3 * static_cast<std::int64_t>(cloud.order[p]) + axis;
            const double scaled = positions[given] / spacing;
            cloud.first[3 * p + axis] = first[given];
            cloud.fraction[axis * (cloud.points + PADDING) + p] = scaled - std::floor(scaled);
        }
    return -1;
}

// Planes are given by their addresses, (components, planes), and hold numbers of the precision in the name. Values are
// (points, components), gradients (points, 3).

#define FOR_PRECISION(Real, name)                                                                                      \
    void splines_at_##name(const Cloud* cloud, std::int64_t components, const Real* const* planes, double* values) {   \
        (cloud->degree == 3 ? interpolate<3, Real> : interpolate<5, Real>)(*cloud, components, planes, values);        \
    }                                                                                                                  \
                                                                                                                       \
    /* Gradients by position, in cells, of the sum over components of `factors` (points, components) times values. */  \
    void splines_slope_##name(const Cloud* cloud, std::int64_t components, const Real* const* planes,                  \
                              const double* factors, double* gradients) {                                              \
        (cloud->degree == 3 ? slope<3, Real> : slope<5, Real>)(*cloud, components, planes, factors, gradients);        \
    }                                                                                                                  \
                                                                                                                       \
    /* Adds to the planes. */                                                                                          \
    void splines_spread_##name(const Cloud* cloud, std::int64_t components, Real* const* planes,                       \
                               const double* values) {                                                                 \
        (cloud->degree == 3 ? spread<3, Real> : spread<5, Real>)(*cloud, components, planes, values);                  \
    }

FOR_PRECISION(double, float64)
FOR_PRECISION(float, float32)

}  // extern "C"
