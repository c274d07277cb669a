// Sums over particles at the points of a regular grid: each particle adds to the points within reach of its kernel.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "smoothing.hpp"

extern "C" {

// Particles, and a rank's planes of a periodic grid with `cells`^2 points in a plane, `spacing` apart.
// kernels/reconstruction.py has the same structure.
struct Reconstruction {
    std::int64_t particles, cells, first_plane, planes, periodic_z;
    double spacing, support;
    const double *position, *kernel;  // (particles, 3); kernel: see smoothing.hpp
    const void* columns;              // (particles, 4), each to be added with the weight W
    void* sums;                       // (planes, cells, cells, 4)
};

}  // extern "C"

namespace {

using eddies::Vector;

// The sums of a plane while particles are added. A line of points has four rows, one for each column. Rows extend
// beyond the box by the reach of a particle at the end of the box.
template <typename Real>
class Plane {
   public:
    Plane(std::int64_t cells, std::int64_t beyond)
        : cells_(cells), width_(cells + beyond), rows_(4 * cells * width_) {}

    Real* row(std::int64_t line, int column) { return rows_.data() + (4 * line + column) * width_; }

    // Write the sums as (line, point, column). Those beyond the box are added at its beginning.
    void write(Real* sums) {
        std::fill_n(sums, 4 * cells_ * cells_, Real(0));
        for (std::int64_t line = 0; line < cells_; ++line)
            for (int column = 0; column < 4; ++column)
                for (std::int64_t x = 0, point = 0; x < width_; ++x) {
                    sums[4 * (line * cells_ + point) + column] += row(line, column)[x];
                    if (++point == cells_) point = 0;
                }
    }

   private:
    std::int64_t cells_, width_;
    std::vector<Real> rows_;
};

// The first grid point at a coordinate or beyond it.
std::int64_t point_from(double coordinate, double spacing) {
    return static_cast<std::int64_t>(std::ceil(coordinate / spacing));
}

std::int64_t wrapped(std::int64_t point, std::int64_t cells) { return (point % cells + cells) % cells; }

// Threads share the planes. A plane gets its particles in their order, each for a vector of points along x at a time.
template <typename Real>
void add_up(const Reconstruction& r) {
    constexpr int lanes = eddies::VectorOf<Real>::lanes;
    const eddies::Smoothing<Real> kernel(r.kernel);
    const double length = r.spacing * static_cast<double>(r.cells);
    std::vector<std::vector<std::int64_t>> near(r.planes);  // particles that reach each plane
    for (std::int64_t p = 0; p < r.particles; ++p) {
        const double z = r.position[3 * p + 2];
        for (std::int64_t plane = point_from(z - r.support, r.spacing); plane * r.spacing <= z + r.support; ++plane) {
            const std::int64_t at = (r.periodic_z ? wrapped(plane, r.cells) : plane) - r.first_plane;
            if (at >= 0 && at < r.planes) near[at].push_back(p);
        }
    }
    const auto square = static_cast<Real>(r.support * r.support);
    const auto across_x = static_cast<std::int64_t>(2 * r.support / r.spacing) / lanes + 1;  // vectors
    Vector<Real> along;
    for (int lane = 0; lane < lanes; ++lane) along[lane] = static_cast<Real>(lane * r.spacing);
#pragma omp parallel for schedule(dynamic, 1)
    for (std::int64_t plane = 0; plane < r.planes; ++plane) {
        Plane<Real> sums(r.cells, across_x * lanes);
        for (const std::int64_t p : near[plane]) {
            const double* position = r.position + 3 * p;
            const Real* column = static_cast<const Real*>(r.columns) + 4 * p;
            double gap = static_cast<double>(r.first_plane + plane) * r.spacing - position[2];
            if (r.periodic_z) gap -= length * std::nearbyint(gap / length);
            const double half = std::sqrt(std::max(r.support * r.support - gap * gap, 0.0));
            const std::int64_t low_x = point_from(position[0] - r.support, r.spacing);
            const std::int64_t low_y = point_from(position[1] - half, r.spacing);
            const auto first_x = static_cast<Real>(static_cast<double>(low_x) * r.spacing - position[0]);
            const std::int64_t x = wrapped(low_x, r.cells);
            double gap_y = static_cast<double>(low_y) * r.spacing - position[1];
            for (std::int64_t line = wrapped(low_y, r.cells); gap_y <= half; gap_y += r.spacing) {
                const auto across = static_cast<Real>(gap * gap + gap_y * gap_y);
                for (std::int64_t v = 0; v < across_x; ++v) {
                    const Vector<Real> gap_x = along + (first_x + static_cast<Real>(v * lanes * r.spacing));
                    const Vector<Real> distance = gap_x * gap_x + across;
                    Vector<Real> root;
                    for (int lane = 0; lane < lanes; ++lane) root[lane] = std::sqrt(distance[lane]);
                    const Vector<Real> weight = distance < square ? kernel.value(root) : Vector<Real>{};
                    for (int c = 0; c < 4; ++c) eddies::add_unaligned(sums.row(line, c) + x + v * lanes, weight * column[c]);
                }
                if (++line == r.cells) line = 0;
            }
        }
        sums.write(static_cast<Real*>(r.sums) + 4 * plane * r.cells * r.cells);
    }
}

}  // namespace

extern "C" {

void reconstruction_sums_float32(const Reconstruction* given) { add_up<float>(*given); }

void reconstruction_sums_float64(const Reconstruction* given) { add_up<double>(*given); }

}  // extern "C"
