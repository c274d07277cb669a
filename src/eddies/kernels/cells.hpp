// Particles in order of place: rows of cells along x, so that what may lie near a point are a few ranges of particles.

#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "vectors.hpp"

namespace eddies {

// How a coordinate is kept: as the fraction of a period that it is at, so that differences are those of nearest images.
// In single precision that is a whole number of 2^-32 periods, whose differences wrap by themselves and are exact.
template <typename Real>
struct Turns;

template <>
struct Turns<float> {
    using type = std::uint32_t;
    static constexpr double UNIT = 1.0 / 4294967296.0;
    static type of(double fraction) { return static_cast<type>(static_cast<std::int64_t>(fraction / UNIT)); }
    static float difference(type a, type b) { return static_cast<float>(static_cast<std::int32_t>(a - b)); }
    static Vector<float> difference(Vector<float> a, Vector<float> b) {  // of bits
        using Unsigned __attribute__((vector_size(VECTOR_BYTES))) = std::uint32_t;
        return __builtin_convertvector((BitVector<float>)((Unsigned)a - (Unsigned)b), Vector<float>);
    }
};

template <>
struct Turns<double> {
    using type = double;
    static constexpr double UNIT = 1.0;
    static type of(double fraction) { return fraction; }
    template <typename One>
    static One difference(One a, One b) {
        constexpr double round = 6755399441055744.0;  // 1.5 2^52, next to which numbers are whole
        const One d = a - b;
        return d - ((d + round) - round);
    }
};

// A range of particles in order of place.
struct Range {
    std::int64_t first, last;
};

// Another row of cells that touches a row, or the row itself; `step` is where it lies along y and z, -1, 0 or 1.
struct NearRow {
    std::int64_t row;
    int step[2];
};

// How far a point is from rows that lie, along one axis, a step back, no step and a step on.
struct Edges {
    double gap[3];
};

template <typename Real>
class Cells {
   public:
    using Turn = typename Turns<Real>::type;

    std::int64_t count = 0, columns = 1, lines = 1, planes = 1;  // columns along x of a row; rows are lines of planes
    std::vector<std::int32_t> order;                             // the caller's row of each particle
    std::vector<Turn> turn[3];
    std::vector<std::int64_t> start;                             // of each cell, x fastest
    Real scale[3];                                               // of differences of turns

    // Particles (count, 3) in a box of this length, periodic along x and y, and along z if so told; cells no narrower
    // than `reach` across rows. Returns -1, or the first particle whose position is not finite.
    std::int64_t arrange(const double* position, std::int64_t particles, double length, bool periodic_z, double reach) {
        count = particles;
        double lowest = 0.0, highest = length;
        for (std::int64_t p = 0; p < count; ++p)
            for (int axis = 0; axis < 3; ++axis)
                if (!std::isfinite(position[3 * p + axis])) return p;
        if (!periodic_z) {
            lowest = highest = count ? position[2] : 0.0;
            for (std::int64_t p = 0; p < count; ++p) {
                lowest = std::min(lowest, position[3 * p + 2]);
                highest = std::max(highest, position[3 * p + 2]);
            }
        }
        wraps[0] = wraps[1] = true;
        wraps[2] = periodic_z;
        const double origin[3] = {0.0, 0.0, lowest}, span = highest - lowest;
        // Where it is not periodic, z has a period so long that no image is near.
        for (int axis = 0; axis < 3; ++axis) period[axis] = length;
        if (!periodic_z) period[2] = 4.0 * std::max(span, reach);
        const double most = std::sqrt(static_cast<double>(count)) + 1.0;  // never many more cells than particles
        lines = at_least_one(std::min(std::floor(length / reach), most));
        planes = at_least_one(std::min(std::floor(span / reach), most));
        columns = at_least_one(std::min(std::floor(4.0 * length / reach),
                                        4.0 * static_cast<double>(count) / static_cast<double>(rows()) + 1.0));
        width[0] = 1.0 / static_cast<double>(columns);
        width[1] = 1.0 / static_cast<double>(lines);
        width[2] = (periodic_z ? 1.0 : span / period[2]) / static_cast<double>(planes);
        std::vector<double> fraction(3 * count);
        std::vector<std::int64_t> cell(count);
        start.assign(rows() * columns + 1, 0);
        for (std::int64_t p = 0; p < count; ++p) {
            std::int64_t index[3];
            for (int axis = 0; axis < 3; ++axis) {
                const double turns = (position[3 * p + axis] - origin[axis]) / period[axis];
                const double f = std::min(std::max(turns - std::floor(turns), 0.0), 1.0 - 1e-15);
                fraction[3 * p + axis] = f;
                const std::int64_t cells = axis == 0 ? columns : axis == 1 ? lines : planes;
                index[axis] = width[axis] > 0.0 ? std::min(static_cast<std::int64_t>(f / width[axis]), cells - 1) : 0;
            }
            cell[p] = (index[2] * lines + index[1]) * columns + index[0];
            ++start[cell[p] + 1];
        }
        for (std::size_t c = 1; c < start.size(); ++c) start[c] += start[c - 1];
        std::vector<std::int64_t> next(start.begin(), start.end() - 1);
        order.resize(count);
        for (auto& column : turn) column.resize(count);
        for (std::int64_t p = 0; p < count; ++p) {
            const std::int64_t place = next[cell[p]]++;
            order[place] = static_cast<std::int32_t>(p);
            for (int axis = 0; axis < 3; ++axis) turn[axis][place] = Turns<Real>::of(fraction[3 * p + axis]);
        }
        for (int axis = 0; axis < 3; ++axis) scale[axis] = static_cast<Real>(period[axis] * Turns<Real>::UNIT);
        return -1;
    }

    std::int64_t rows() const { return lines * planes; }

    Range of_row(std::int64_t row) const { return {start[row * columns], start[(row + 1) * columns]}; }

    // The rows that touch a row, itself included, each once.
    void near(std::int64_t row, std::vector<NearRow>& found) const {
        found.clear();
        const std::int64_t z = row / lines, y = row % lines;
        for (int dz = -1; dz <= 1; ++dz)
            for (int dy = -1; dy <= 1; ++dy) {
                std::int64_t other_z = z + dz, other_y = (y + dy + lines) % lines;
                if (wraps[2]) other_z = (other_z + planes) % planes;
                if (other_z < 0 || other_z >= planes) continue;
                const std::int64_t other = other_z * lines + other_y;
                const bool known = std::any_of(found.begin(), found.end(),
                                               [other](const NearRow& it) { return it.row == other; });
                if (!known) found.push_back({other, {dy, dz}});
            }
    }

    // Those particles of a row near another that may be within a distance of a point in that one, which is so far from
    // the edges of its row, and at this fraction of a period along x: up to two ranges.
    int within(double x, const Edges* edges, const NearRow& near, double distance, Range* ranges) const {
        double left = distance * distance;
        for (int across = 0; across < 2; ++across) {
            const double gap = edges[across].gap[near.step[across] + 1];
            left -= gap * gap;
        }
        if (left <= 0.0) return 0;
        const double half = std::sqrt(left) / period[0] + 1e-9, place = x + 1.0;  // so that it is not negative
        const std::int64_t* row_start = &start[near.row * columns];
        const auto low = static_cast<std::int64_t>((place - half) * static_cast<double>(columns));
        const auto high = static_cast<std::int64_t>((place + half) * static_cast<double>(columns));
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

    // How far a particle in a row is from the rows on both sides of that.
    void edges(std::int64_t place, std::int64_t line, std::int64_t plane, Edges* found) const {
        const std::int64_t index[2] = {line, plane}, cells[2] = {lines, planes};
        for (int across = 0; across < 2; ++across) {
            const int axis = across + 1;
            const double at = fraction(axis, place), lower = static_cast<double>(index[across]) * width[axis];
            // Where there are only two rows, one is on both sides of the other.
            const double known = wraps[axis] && cells[across] < 3 ? 0.0 : period[axis];
            found[across] = {{std::max(at - lower, 0.0) * known, 0.0, std::max(lower + width[axis] - at, 0.0) * known}};
        }
    }

    // Fraction of a period at which a particle is.
    double fraction(int axis, std::int64_t place) const {
        return static_cast<double>(turn[axis][place]) * Turns<Real>::UNIT;
    }

   private:
    double period[3], width[3];  // and how wide a cell is, in periods
    bool wraps[3];

    static std::int64_t at_least_one(double number) { return std::max<std::int64_t>(static_cast<std::int64_t>(number), 1); }
};

}  // namespace eddies
