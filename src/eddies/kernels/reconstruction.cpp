// Sums over particles at the points of a regular grid: each particle adds to the points within reach of its kernel.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "smoothing.hpp"

extern "C" {

// Particles, and those planes of a periodic grid of `cells`^2 points a plane, `spacing` apart, that a rank has;
// kernels/reconstruction.py has the same structure.
struct Reconstruction {
    std::int64_t particles, cells, first_plane, planes, periodic_z;
    double spacing, support;
    const double *position, *kernel;  // (particles, 3), and as smoothing.hpp wants it
    const void* columns;              // (particles, 4), each to be added with the weight W
    void* sums;                       // (planes, cells, cells, 4), zero at first
};

}  // extern "C"

namespace {

template <typename Real>
struct FourOf {
    typedef Real type __attribute__((vector_size(4 * sizeof(Real)), aligned(alignof(Real)), may_alias));
};

// Planes are shared by threads; each adds up its particles in their order.
template <typename Real>
void add_up(const Reconstruction& r) {
    using Four = typename FourOf<Real>::type;
    const eddies::Smoothing<Real> kernel(r.kernel);
    std::vector<std::vector<std::int64_t>> near(r.planes);  // particles that reach each plane
    for (std::int64_t p = 0; p < r.particles; ++p) {
        const double z = r.position[3 * p + 2];
        const auto low = static_cast<std::int64_t>(std::ceil((z - r.support) / r.spacing));
        const auto high = static_cast<std::int64_t>(std::floor((z + r.support) / r.spacing));
        for (std::int64_t plane = low; plane <= high; ++plane) {
            const std::int64_t at = (r.periodic_z ? (plane % r.cells + r.cells) % r.cells : plane) - r.first_plane;
            if (at >= 0 && at < r.planes) near[at].push_back(p);
        }
    }
    const auto square = static_cast<Real>(r.support * r.support);
#pragma omp parallel for schedule(dynamic, 1)
    for (std::int64_t plane = 0; plane < r.planes; ++plane) {
        Four* sums = static_cast<Four*>(r.sums) + plane * r.cells * r.cells;
        for (const std::int64_t p : near[plane]) {
            const double *position = r.position + 3 * p, length = r.spacing * static_cast<double>(r.cells);
            double gap = static_cast<double>(r.first_plane + plane) * r.spacing - position[2];
            if (r.periodic_z) gap -= length * std::nearbyint(gap / length);
            const Four column = static_cast<const Four*>(r.columns)[p];
            const double left = r.support * r.support - gap * gap;
            if (left <= 0) continue;
            const double half = std::sqrt(left);
            const auto low_y = static_cast<std::int64_t>(std::ceil((position[1] - half) / r.spacing));
            const auto high_y = static_cast<std::int64_t>(std::floor((position[1] + half) / r.spacing));
            for (std::int64_t y = low_y; y <= high_y; ++y) {
                const double gap_y = static_cast<double>(y) * r.spacing - position[1], room = left - gap_y * gap_y;
                if (room <= 0) continue;
                const double half_x = std::sqrt(room);
                const auto low_x = static_cast<std::int64_t>(std::ceil((position[0] - half_x) / r.spacing));
                const auto high_x = static_cast<std::int64_t>(std::floor((position[0] + half_x) / r.spacing));
                Four* line = sums + (y % r.cells + r.cells) % r.cells * r.cells;
                const auto across = static_cast<Real>(gap * gap + gap_y * gap_y);
                std::int64_t column_x = (low_x % r.cells + r.cells) % r.cells;
                for (std::int64_t x = low_x; x <= high_x; ++x) {
                    const auto gap_x = static_cast<Real>(static_cast<double>(x) * r.spacing - position[0]);
                    const Real distance = gap_x * gap_x + across;
                    if (distance < square) line[column_x] += kernel.value(std::sqrt(distance)) * column;
                    if (++column_x == r.cells) column_x = 0;
                }
            }
        }
    }
}

}  // namespace

extern "C" {

void reconstruction_sums_float32(const Reconstruction* given) { add_up<float>(*given); }

void reconstruction_sums_float64(const Reconstruction* given) { add_up<double>(*given); }

}  // extern "C"
