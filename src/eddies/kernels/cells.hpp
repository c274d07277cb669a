// Particles sorted by place, in rows of cells along x. The neighbours of a point then lie in a few ranges of particles.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "vectors.hpp"

namespace eddies {

// Coordinates are stored as fractions of a period, so that differences are those of nearest images. In single precision
// a fraction is an integer in units of 2^-32 periods: differences wrap by themselves and are exact.
template <typename Real>
struct Turns;

template <>
struct Turns<float> {
    using type = std::uint32_t;
    static constexpr double UNIT = 1.0 / 4294967296.0;
    static type of(double fraction) { return static_cast<type>(static_cast<std::int64_t>(fraction / UNIT)); }
    static Vector<float> all(type one) {
        return (Vector<float>)(BitVector<float>{} + static_cast<std::int32_t>(one));
    }
    static Vector<float> difference(Vector<float> a, Vector<float> b) {  // of the integers in their bits
        using Unsigned __attribute__((vector_size(VECTOR_BYTES))) = std::uint32_t;
        return __builtin_convertvector((BitVector<float>)((Unsigned)a - (Unsigned)b), Vector<float>);
    }
};

template <>
struct Turns<double> {
    using type = double;
    static constexpr double UNIT = 1.0;
    static type of(double fraction) { return fraction; }
    static Vector<double> all(type one) { return Vector<double>{} + one; }
    static Vector<double> difference(Vector<double> a, Vector<double> b) {
        constexpr double round = 6755399441055744.0;  // 1.5 * 2^52; adding it rounds a number to an integer
        const Vector<double> d = a - b;
        return d - ((d + round) - round);
    }
};

constexpr int CANDIDATES = 64;  // particles that are looked at together, a bit for each

// Index of the first position (count, 3) that is not finite, or -1.
inline std::int64_t not_finite(const double* position, std::int64_t count) {
    for (std::int64_t p = 0; p < count; ++p)
        if (!std::isfinite(position[3 * p] + position[3 * p + 1] + position[3 * p + 2])) return p;
    return -1;
}

// A range of sorted particles.
struct Range {
    std::int64_t first, last;
};

// A row of cells that touches a given row, or the given row itself. `step` is its place along y and z relative to the
// given row: -1, 0 or 1.
struct NearRow {
    std::int64_t row;
    int step[2];
};

// A range of columns of a row, the last one included.
struct Columns {
    std::int32_t first, last;
};

// Distances of a point along one axis: from the row one step back, from its own row and from the row one step ahead.
struct Edges {
    double gap[3];
};

template <typename Real>
class Cells {
   public:
    using Turn = typename Turns<Real>::type;

    std::int64_t count = 0, columns = 1, lines = 1, planes = 1;  // `columns` cells of a row; a plane has `lines` rows
    std::vector<std::int32_t> order;                             // of each particle, its row in the caller's arrays
    std::vector<Turn> turn[3];
    std::vector<std::int64_t> start;                             // first particle of each cell; x varies fastest
    Real scale[3];                                               // factors from differences of turns to lengths

    // Sort particles at `position` (particles, 3) in a box of edge `length`, which is periodic along x and y, and along
    // z if `periodic_z`. Cells are at least `reach` wide along y and z. `points` (number, 3), or null, are other points
    // for which `place` will be called. All coordinates are finite.
    void arrange(const double* position, std::int64_t particles, const double* points, std::int64_t number,
                 double length, bool periodic_z, double reach) {
        count = particles;
        double lowest = 0.0, highest = length;
        if (!periodic_z) {
            lowest = count ? position[2] : number ? points[2] : 0.0;
            highest = lowest;
            const auto span_of = [&](const double* some, std::int64_t size) {
                for (std::int64_t p = 0; p < size; ++p) {
                    lowest = std::min(lowest, some[3 * p + 2]);
                    highest = std::max(highest, some[3 * p + 2]);
                }
            };
            span_of(position, count);
            span_of(points, number);
        }
        wraps[0] = wraps[1] = true;
        wraps[2] = periodic_z;
        origin = lowest;
        const double span = highest - lowest;
        // Without periodicity z gets a period so long that no image is near.
        for (double& one : period) one = length;
        if (!periodic_z) period[2] = 4.0 * std::max(span, reach);
        const double most = std::sqrt(static_cast<double>(count)) + 1.0;  // never many more cells than particles
        lines = at_least_one(std::min(std::floor(length / reach), most));
        planes = at_least_one(std::min(std::floor(span / reach), most));
        columns = at_least_one(std::min(std::floor(4.0 * length / reach),
                                        4.0 * static_cast<double>(count) / static_cast<double>(rows()) + 1.0));
        width[0] = 1.0 / static_cast<double>(columns);
        width[1] = 1.0 / static_cast<double>(lines);
        width[2] = (periodic_z ? 1.0 : span / period[2]) / static_cast<double>(planes);
        std::vector<Place> places(count);
        start.assign(rows() * columns + 1, 0);
#pragma omp parallel for schedule(static)
        for (std::int64_t p = 0; p < count; ++p) places[p] = place(position + 3 * p);
        for (const Place& one : places) ++start[one.cell(*this) + 1];
        for (std::size_t c = 1; c < start.size(); ++c) start[c] += start[c - 1];
        std::vector<std::int64_t> next(start.begin(), start.end() - 1);
        order.resize(count);
        for (auto& column : turn) column.resize(count + VectorOf<Real>::lanes);  // `nearer` reads beyond the last one
        for (std::int64_t p = 0; p < count; ++p) {
            const std::int64_t at = next[places[p].cell(*this)]++;
            order[at] = static_cast<std::int32_t>(p);
            for (int axis = 0; axis < 3; ++axis) turn[axis][at] = Turns<Real>::of(places[p].fraction[axis]);
        }
        for (int axis = 0; axis < 3; ++axis) scale[axis] = static_cast<Real>(period[axis] * Turns<Real>::UNIT);
    }

    // Where a point is: fractions of the periods, and indices of its cell along x, y and z.
    struct Place {
        double fraction[3];
        std::int64_t index[3];

        std::int64_t row(const Cells& cells) const { return index[2] * cells.lines + index[1]; }
        std::int64_t cell(const Cells& cells) const { return row(cells) * cells.columns + index[0]; }
    };

    Place place(const double* position) const {
        Place place;
        const std::int64_t cells[3] = {columns, lines, planes};
        for (int axis = 0; axis < 3; ++axis) {
            const double turns = (position[axis] - (axis == 2 ? origin : 0.0)) / period[axis];
            const double fraction = std::min(std::max(turns - std::floor(turns), 0.0), 1.0 - 1e-15);
            place.fraction[axis] = fraction;
            place.index[axis] =
                width[axis] > 0.0 ? std::min(static_cast<std::int64_t>(fraction / width[axis]), cells[axis] - 1) : 0;
        }
        return place;
    }

    std::int64_t rows() const { return lines * planes; }

    Range of_row(std::int64_t row) const { return {start[row * columns], start[(row + 1) * columns]}; }

    // The rows that touch a row, itself included, each once.
    void near(std::int64_t row, std::vector<NearRow>& rows) const {
        rows.clear();
        const std::int64_t z = row / lines, y = row % lines;
        for (int dz = -1; dz <= 1; ++dz)
            for (int dy = -1; dy <= 1; ++dy) {
                std::int64_t other_z = z + dz, other_y = (y + dy + lines) % lines;
                if (wraps[2]) other_z = (other_z + planes) % planes;
                if (other_z < 0 || other_z >= planes) continue;
                const std::int64_t other = other_z * lines + other_y;
                const bool listed = std::any_of(rows.begin(), rows.end(),
                                               [other](const NearRow& it) { return it.row == other; });
                if (!listed) rows.push_back({other, {dy, dz}});
            }
    }

    // Find the particles of a nearby row that may be within `distance` of a point. `x` is the point's fraction of a
    // period along x, and `edges` are its distances from the rows around it. Returns the number of ranges, at most two.
    int within(double x, const Edges* edges, const NearRow& near, double distance, Range* ranges) const {
        double left = distance * distance;
        for (int across = 0; across < 2; ++across) {
            const double gap = edges[across].gap[near.step[across] + 1];
            left -= gap * gap;
        }
        if (left <= 0.0) return 0;
        const double half = std::sqrt(left) / period[0] + 1e-9, place = x + 1.0;  // so that it is not negative
        return pieces(near.row, static_cast<std::int64_t>((place - half) * static_cast<double>(columns)),
                      static_cast<std::int64_t>((place + half) * static_cast<double>(columns)), ranges);
    }

    // Find the particles of a row in the columns `low` to `high`. A period, the number of columns, has been added to
    // both. Returns the number of ranges, at most two.
    int pieces(std::int64_t row, std::int64_t low, std::int64_t high, Range* ranges) const {
        const std::int64_t* row_start = &start[row * columns];
        if (high - low + 1 >= columns) {
            ranges[0] = {row_start[0], row_start[columns]};
            return 1;
        }
        const std::int64_t first = low < columns ? low : low - columns;
        std::int64_t last = high < columns ? high : high - columns;
        last = last < columns ? last : last - columns;
        if (first <= last) {
            ranges[0] = {row_start[first], row_start[last + 1]};
            return 1;
        }
        ranges[0] = {row_start[0], row_start[last + 1]};
        ranges[1] = {row_start[first], row_start[columns]};
        return 2;
    }

    // For each particle of a row, find the columns of a nearby row that may hold particles within `distance`. A period
    // is added to them, as `pieces` needs it. If there are no such columns, the last column lies before the first.
    void columns_within(std::int64_t row, const NearRow& near, double distance, Columns* columns_near) const {
        const std::int64_t cells[2] = {lines, planes}, index[2] = {row % lines, row / lines};
        double edge[2], slope[2];  // gap across = slope * (fraction of the particle - edge)
        for (int across = 0; across < 2; ++across) {
            const int axis = across + 1, step = near.step[across];
            edge[across] = static_cast<double>(index[across] + (step > 0)) * width[axis];
            // Where there are only two rows, one is on both sides of the other.
            slope[across] = wraps[axis] && cells[across] < 3 ? 0.0 : -step * period[axis];
        }
        const double square = distance * distance, unit = Turns<Real>::UNIT, number = static_cast<double>(columns);
        const Range own = of_row(row);
        const Turn *xs = &turn[0][own.first], *ys = &turn[1][own.first], *zs = &turn[2][own.first];
#pragma omp simd
        for (std::int64_t i = 0; i < own.last - own.first; ++i) {
            const double gap_y = std::max((static_cast<double>(ys[i]) * unit - edge[0]) * slope[0], 0.0),
                         gap_z = std::max((static_cast<double>(zs[i]) * unit - edge[1]) * slope[1], 0.0);
            const double left = square - gap_y * gap_y - gap_z * gap_z;
            const double half = std::sqrt(std::max(left, 0.0)) / period[0] + 1e-9;
            const double place = static_cast<double>(xs[i]) * unit + 1.0;  // so that it is not negative
            columns_near[i].first = static_cast<std::int32_t>((place - half) * number);
            columns_near[i].last = left > 0.0 ? static_cast<std::int32_t>((place + half) * number) : -1;
        }
    }

    // Find the distances of a point from the rows on both sides of its own.
    void edges(const Place& place, Edges* result) const {
        const std::int64_t cells[2] = {lines, planes};
        for (int across = 0; across < 2; ++across) {
            const int axis = across + 1;
            const double at = place.fraction[axis], lower = static_cast<double>(place.index[axis]) * width[axis];
            // Where there are only two rows, one is on both sides of the other.
            const double unit = wraps[axis] && cells[across] < 3 ? 0.0 : period[axis];
            result[across] = {{std::max(at - lower, 0.0) * unit, 0.0, std::max(lower + width[axis] - at, 0.0) * unit}};
        }
    }

    // One bit for each of up to CANDIDATES consecutive particles: whether its squared distance from the point with the
    // turns `at` is below `limit`.
    std::uint64_t nearer(const Turn* at, std::int64_t begin, int number, Real limit) const {
        using T = Turns<Real>;
        using V = Vector<Real>;
        constexpr int lanes = VectorOf<Real>::lanes;
        std::uint64_t mask = 0;
        for (int p = 0; p < number; p += lanes) {
            V square{};
            for (int axis = 0; axis < 3; ++axis) {
                const V d = T::difference(T::all(at[axis]), unaligned(&turn[axis][begin + p])) * scale[axis];
                square += d * d;
            }
            mask |= bits(square < limit) << p;
        }
        return number < CANDIDATES ? mask & ((std::uint64_t(1) << number) - 1) : mask;
    }

   private:
    double origin, period[3], width[3];  // lowest z; periods; widths of a cell, in periods
    bool wraps[3];

    static std::int64_t at_least_one(double number) { return static_cast<std::int64_t>(std::max(number, 1.0)); }
};

}  // namespace eddies
