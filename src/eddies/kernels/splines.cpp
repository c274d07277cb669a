// Tensor-product B-splines between points and the planes of a periodic grid; spectral/splines.py is the definition.
//
// Points are put in order of place once. The splines around them are made anew in each call from what fraction of a cell
// they are at: that costs less than to store and load them. Nothing depends on the number of threads: a value is the sum
// of one thread, and what points add to a plane they add in one order.

#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

extern "C" {

// Points in order of place, as `splines_arrange` makes it; kernels/splines.py has the same structure.
//
// The splines around a point begin at the column, line and plane `first`, which is (degree - 1)/2 before its cell; the
// point is at `fraction` of the cell. The lines are cut into `chunks`, one or an even number of them, so long that what
// lies around the points of every other chunk has no line in common.
struct Cloud {
    std::int64_t points, cells, planes, degree, chunks;
    std::int32_t* order;     // (points), rows of the caller's arrays
    std::int32_t* first;     // (points, 3)
    double* fraction;        // (points, 3)
    std::int64_t* starts;    // (chunks + 1), where the points of each chunk begin
    std::int64_t* lines;     // (cells + degree), where lines begin in a plane, periodically
};

}  // extern "C"

namespace {

constexpr int BLOCK = 8;               // points whose splines are made together
constexpr int PLANES = 4, COLUMNS = 8;  // of cells whose points need no further order: what they reach fits a cache
constexpr int FEW = 2000;              // points that are not worth a second thread
constexpr double FARTHEST = 1e15;      // in cells; beyond, numbers do not tell one from the next

using Quad = double __attribute__((vector_size(32)));
using Pair = double __attribute__((vector_size(16)));
using FloatQuad = float __attribute__((vector_size(16)));
using FloatPair = float __attribute__((vector_size(8)));

template <typename Vector, typename Stored>
inline void convert(const void* place, Vector& vector) {
    Stored stored;
    std::memcpy(&stored, place, sizeof(stored));
    vector = __builtin_convertvector(stored, Vector);
}

// Neighbours on a line, four or six, in registers.
template <int width>
struct Line {
    Quad low;
    Pair high;

    void load(const double* place) {
        convert<Quad, Quad>(place, low);
        if constexpr (width > 4) convert<Pair, Pair>(place + 4, high);
    }

    void load(const float* place) {
        convert<Quad, FloatQuad>(place, low);
        if constexpr (width > 4) convert<Pair, FloatPair>(place + 4, high);
    }

    void store(double* place) const {
        std::memcpy(place, &low, sizeof(low));
        if constexpr (width > 4) std::memcpy(place + 4, &high, sizeof(high));
    }

    void add(double factor, const Line& other) {
        low += factor * other.low;
        if constexpr (width > 4) high += factor * other.high;
    }

    double dot(const Line& other) const {
        const Quad product = low * other.low;
        double sum = (product[0] + product[2]) + (product[1] + product[3]);
        if constexpr (width > 4) sum += high[0] * other.high[0] + high[1] * other.high[1];
        return sum;
    }
};

// One number for each point of a block.
using Numbers = double[BLOCK];

// The weights of splines along one axis, by the recursion of de Boor on uniform knots.
template <int degree>
inline void make_weights(const Numbers& fraction, Numbers* weights) {
    for (int p = 0; p < BLOCK; ++p) weights[0][p] = 1.0;
#pragma GCC unroll 5
    for (int order = 1; order <= degree; ++order) {
        const double share = 1.0 / order;
        Numbers carried = {};
#pragma GCC unroll 5
        for (int i = 0; i < order; ++i)
            for (int p = 0; p < BLOCK; ++p) {
                // The distance of the point from the left end of each of the overlapping splines.
                const double left = fraction[p] + (order - 1 - i), weight = weights[i][p] * share;
                weights[i][p] = carried[p] + weight * (order - left);
                carried[p] = weight * left;
            }
        for (int p = 0; p < BLOCK; ++p) weights[order][p] = carried[p];
    }
}

// Their derivatives with respect to the fraction: differences of the next lower degree.
template <int degree>
inline void make_slopes(const Numbers& fraction, Numbers* slopes) {
    make_weights<degree - 1>(fraction, slopes);
    for (int p = 0; p < BLOCK; ++p) slopes[degree][p] = slopes[degree - 1][p];
    for (int i = degree - 1; i > 0; --i)
        for (int p = 0; p < BLOCK; ++p) slopes[i][p] = slopes[i - 1][p] - slopes[i][p];
    for (int p = 0; p < BLOCK; ++p) slopes[0][p] = -slopes[0][p];
}

// Weights across lines, those of the planes times those of the lines in them.
template <int width>
using Across = Numbers[width][width];

template <int width>
inline void multiply(const Numbers* z, const Numbers* y, Across<width>& across) {
    for (int k = 0; k < width; ++k)
        for (int j = 0; j < width; ++j)
            for (int p = 0; p < BLOCK; ++p) across[k][j][p] = z[k][p] * y[j][p];
}

// The points `begin` ... `begin + count` - 1 of a cloud, with the weights of the splines around them.
template <int degree>
struct Block {
    static constexpr int width = degree + 1;
    const Cloud& cloud;
    std::int64_t begin;
    int count;
    alignas(64) Numbers fraction[3], along[3][width];
    alignas(64) Across<width> across;

    Block(const Cloud& cloud, std::int64_t begin, std::int64_t end)
        : cloud(cloud), begin(begin), count(static_cast<int>(end - begin < BLOCK ? end - begin : BLOCK)) {
        for (int p = 0; p < BLOCK; ++p)
            for (int axis = 0; axis < 3; ++axis)
                fraction[axis][p] = p < count ? cloud.fraction[3 * (begin + p) + axis] : 0.0;
        for (int axis = 0; axis < 3; ++axis) make_weights<degree>(fraction[axis], along[axis]);
        multiply<width>(along[2], along[1], across);
    }

    std::int64_t row(int p) const { return cloud.order[begin + p]; }
};

template <int width>
inline Line<width> of_point(const Numbers* weights, int p) {
    Line<width> line;
    line.low = Quad{weights[0][p], weights[1][p], weights[2][p], weights[3][p]};
    if constexpr (width > 4) line.high = Pair{weights[4][p], weights[5][p]};
    return line;
}

// Where the lines around a point are.
template <int width>
struct Place {
    std::int64_t column, cells;
    const std::int64_t* lines;
    std::int64_t plane;
    bool cut;  // by the end of the box

    Place(const Cloud& cloud, std::int64_t point)
        : column(cloud.first[3 * point]), cells(cloud.cells), lines(cloud.lines + cloud.first[3 * point + 1]),
          plane(cloud.first[3 * point + 2]), cut(column + width > cells) {}

    template <typename Real>
    void load(const Real* line, Line<width>& values) const {
        if (!cut) return values.load(line + column);
        Real whole[width];
        for (int i = 0; i < width; ++i) whole[i] = line[(column + i) % cells];
        values.load(whole);
    }

    void add(double* line, double factor, const Line<width>& values) const {
        if (!cut) {
            Line<width> sum;
            sum.load(line + column);
            sum.add(factor, values);
            return sum.store(line + column);
        }
        double whole[width];
        values.store(whole);
        for (int i = 0; i < width; ++i) line[(column + i) % cells] += factor * whole[i];
    }
};

template <int degree, typename Real>
void interpolate(const Cloud& cloud, std::int64_t components, const Real* const* planes, double* values) {
    constexpr int width = degree + 1;
#pragma omp parallel for schedule(static) if (cloud.points > FEW)
    for (std::int64_t begin = 0; begin < cloud.points; begin += BLOCK) {
        const Block<degree> block(cloud, begin, cloud.points);
        for (int p = 0; p < block.count; ++p) {
            const Place<width> place(cloud, begin + p);
            const Line<width> x = of_point<width>(block.along[0], p);
            for (std::int64_t c = 0; c < components; ++c) {
                const Real* const* plane = planes + c * cloud.planes + place.plane;
                Line<width> sum{}, line;
                for (int k = 0; k < width; ++k)
                    for (int j = 0; j < width; ++j) {
                        place.load(plane[k] + place.lines[j], line);
                        sum.add(block.across[k][j][p], line);
                    }
                values[block.row(p) * components + c] = sum.dot(x);
            }
        }
    }
}

template <int degree, typename Real>
void slope(const Cloud& cloud, std::int64_t components, const Real* const* planes, const double* factors,
           double* gradients) {
    constexpr int width = degree + 1;
#pragma omp parallel for schedule(static) if (cloud.points > FEW)
    for (std::int64_t begin = 0; begin < cloud.points; begin += BLOCK) {
        const Block<degree> block(cloud, begin, cloud.points);
        alignas(64) Numbers slopes[3][width];
        alignas(64) Across<width> dy, dz;
        for (int axis = 0; axis < 3; ++axis) make_slopes<degree>(block.fraction[axis], slopes[axis]);
        multiply<width>(block.along[2], slopes[1], dy);
        multiply<width>(slopes[2], block.along[1], dz);
        for (int p = 0; p < block.count; ++p) {
            const Place<width> place(cloud, begin + p);
            const Line<width> x = of_point<width>(block.along[0], p), dx = of_point<width>(slopes[0], p);
            Line<width> by_x{}, by_y{}, by_z{};
            for (std::int64_t c = 0; c < components; ++c) {
                const Real* const* plane = planes + c * cloud.planes + place.plane;
                const double factor = factors[block.row(p) * components + c];
                Line<width> line;
                for (int k = 0; k < width; ++k)
                    for (int j = 0; j < width; ++j) {
                        place.load(plane[k] + place.lines[j], line);
                        by_x.add(factor * block.across[k][j][p], line);
                        by_y.add(factor * dy[k][j][p], line);
                        by_z.add(factor * dz[k][j][p], line);
                    }
            }
            double* gradient = gradients + 3 * block.row(p);
            gradient[0] = by_x.dot(dx);
            gradient[1] = by_y.dot(x);
            gradient[2] = by_z.dot(x);
        }
    }
}

template <int degree>
void spread(const Cloud& cloud, std::int64_t components, double* const* planes, const double* values) {
    constexpr int width = degree + 1;
    for (std::int64_t parity = 0; parity < 2; ++parity) {
#pragma omp parallel for schedule(dynamic, 1) if (cloud.points > FEW)
        for (std::int64_t chunk = parity; chunk < cloud.chunks; chunk += 2)
            for (std::int64_t begin = cloud.starts[chunk]; begin < cloud.starts[chunk + 1]; begin += BLOCK) {
                const Block<degree> block(cloud, begin, cloud.starts[chunk + 1]);
                for (int p = 0; p < block.count; ++p) {
                    const Place<width> place(cloud, begin + p);
                    const Line<width> x = of_point<width>(block.along[0], p);
                    for (std::int64_t c = 0; c < components; ++c) {
                        double* const* plane = planes + c * cloud.planes + place.plane;
                        Line<width> line{};
                        line.add(values[block.row(p) * components + c], x);
                        for (int k = 0; k < width; ++k)
                            for (int j = 0; j < width; ++j)
                                place.add(plane[k] + place.lines[j], block.across[k][j][p], line);
                    }
                }
            }
    }
}

std::int64_t first_line(const Cloud& cloud, std::int64_t chunk) { return chunk * cloud.cells / cloud.chunks; }

}  // namespace

extern "C" {

// Makes the arrays of a cloud, of points (n, 3) on a grid of this spacing whose plane `lowest` is the first in memory.
// Returns -1, or the number of the first point that has no place there, and then the arrays are not made.
std::int64_t splines_arrange(const Cloud* arranged, const double* positions, double spacing, std::int64_t lowest) {
    const Cloud& cloud = *arranged;
    const std::int64_t cells = cloud.cells, before = (cloud.degree - 1) / 2;
    const std::int64_t deep = (cloud.planes - 1) / PLANES + 1, broad = (cells - 1) / COLUMNS + 1;
    std::vector<std::int32_t> first(3 * cloud.points), bins(cloud.points), next(cloud.chunks * deep * broad + 1);
    std::vector<std::int32_t> chunk_of(cells);
    for (std::int64_t chunk = 0; chunk < cloud.chunks; ++chunk)
        for (std::int64_t line = first_line(cloud, chunk); line < first_line(cloud, chunk + 1); ++line)
            chunk_of[line] = static_cast<std::int32_t>(chunk);
    std::int64_t misplaced = cloud.points;
#pragma omp parallel for schedule(static) reduction(min : misplaced) if (cloud.points > FEW)
    for (std::int64_t p = 0; p < cloud.points; ++p) {
        std::int32_t* place = &first[3 * p];
        bool placed = true;
        for (int axis = 0; axis < 3; ++axis) {
            const double cell = std::floor(positions[3 * p + axis] / spacing);
            placed = placed && std::abs(cell) < FARTHEST;  // what is not a number is not
            const std::int64_t index =
                placed ? (static_cast<std::int64_t>(cell) - before - (axis == 2 ? lowest : 0)) % cells : 0;
            place[axis] = static_cast<std::int32_t>(index < 0 ? index + cells : index);
        }
        if (placed && place[2] + cloud.degree < cloud.planes)
            bins[p] = static_cast<std::int32_t>((chunk_of[place[1]] * deep + place[2] / PLANES) * broad +
                                                place[0] / COLUMNS);
        else if (p < misplaced) misplaced = p;
    }
    if (misplaced < cloud.points) return misplaced;
    for (std::int64_t p = 0; p < cloud.points; ++p) ++next[bins[p] + 1];
    for (std::size_t bin = 1; bin < next.size(); ++bin) next[bin] += next[bin - 1];
    for (std::int64_t chunk = 0; chunk <= cloud.chunks; ++chunk) cloud.starts[chunk] = next[chunk * deep * broad];
    for (std::int64_t p = 0; p < cloud.points; ++p) cloud.order[next[bins[p]]++] = static_cast<std::int32_t>(p);
#pragma omp parallel for schedule(static) if (cloud.points > FEW)
    for (std::int64_t p = 0; p < cloud.points; ++p)
        for (int axis = 0; axis < 3; ++axis) {
            const std::int64_t given = 3 * static_cast<std::int64_t>(cloud.order[p]) + axis;
            const double scaled = positions[given] / spacing;
            cloud.first[3 * p + axis] = first[given];
            cloud.fraction[3 * p + axis] = scaled - std::floor(scaled);
        }
    for (std::int64_t line = 0; line < cells + cloud.degree; ++line) cloud.lines[line] = line % cells * cells;
    return -1;
}

// Planes are given by their addresses, (components, planes). Values are (points, components), gradients (points, 3).

void splines_at_float64(const Cloud* cloud, std::int64_t components, const double* const* planes, double* values) {
    (cloud->degree == 3 ? interpolate<3, double> : interpolate<5, double>)(*cloud, components, planes, values);
}

void splines_at_float32(const Cloud* cloud, std::int64_t components, const float* const* planes, double* values) {
    (cloud->degree == 3 ? interpolate<3, float> : interpolate<5, float>)(*cloud, components, planes, values);
}

// Gradients by position, in cells, of the sum over components of `factors` (points, components) times the values.
void splines_slope(const Cloud* cloud, std::int64_t components, const double* const* planes, const double* factors,
                   double* gradients) {
    (cloud->degree == 3 ? slope<3, double> : slope<5, double>)(*cloud, components, planes, factors, gradients);
}

// Adds to the planes.
void splines_spread(const Cloud* cloud, std::int64_t components, double* const* planes, const double* values) {
    (cloud->degree == 3 ? spread<3> : spread<5>)(*cloud, components, planes, values);
}

}  // extern "C"
