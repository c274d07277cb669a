// Pointwise formulas of the direct numerical simulation: each reads and writes the memory once.
// tests/kernels/test_flow.py compares them with numpy. Complex numbers are real and imaginary part.

#include <algorithm>
#include <cstdint>
#include <vector>

extern "C" {

// Modes (kz, ky, kx) with kx = 0 ... cutoff, kz = 0 ... cutoff, -cutoff ... -1, and `lines` values of ky; kx, ky and kz
// are the wavenumbers along the axes. kernels/flow.py has the same structure.
struct Modes {
    std::int64_t cutoff, lines;
    const void *kx, *ky, *kz;
};

}  // extern "C"

namespace {

using Int = std::int64_t;

constexpr Int FEW = 1 << 14;  // with fewer numbers, one thread is used

// Successive fields are `apart` numbers from each other.
template <typename Real, bool viscous>
void advection(Int points, Int apart, const Real* fields, Real nu, Int out_apart, Real* out) {
    const Real *u = fields, *x = fields + 3 * apart, *y = x + 4 * apart, *z = y + 4 * apart;
#pragma omp parallel for simd schedule(static) if (parallel : points > FEW)
    for (Int i = 0; i < points; ++i) {
        const Real a = u[i], b = u[i + apart], c = u[i + 2 * apart];
        const Real ux = x[i], vx = x[i + apart], wx = x[i + 2 * apart], sx = x[i + 3 * apart];
        const Real uy = y[i], vy = y[i + apart], wy = y[i + 2 * apart], sy = y[i + 3 * apart];
        const Real uz = z[i], vz = z[i + apart], wz = z[i + 2 * apart], sz = z[i + 3 * apart];
        Real du = 0, dv = 0, dw = 0;
        if (viscous) {
            const Real third = Real(2.0 / 3.0) * (ux + vy + wz);
            du = nu * ((ux + ux - third) * sx + (uy + vx) * sy + (uz + wx) * sz);
            dv = nu * ((vx + uy) * sx + (vy + vy - third) * sy + (vz + wy) * sz);
            dw = nu * ((wx + uz) * sx + (wy + vz) * sy + (wz + wz - third) * sz);
        }
        out[i] = du - (a * ux + b * uy + c * uz);
        out[i + out_apart] = dv - (a * vx + b * vy + c * vz);
        out[i + 2 * out_apart] = dw - (a * wx + b * wy + c * wz);
        out[i + 3 * out_apart] = -(a * sx + b * sy + c * sz);
    }
}

template <typename Real>
void cross(Int points, Int apart, const Real* fields, Int out_apart, Real* out) {
    const Real *u = fields, *omega = fields + 3 * apart;
#pragma omp parallel for simd schedule(static) if (parallel : points > FEW)
    for (Int i = 0; i < points; ++i) {
        const Real a = u[i], b = u[i + apart], c = u[i + 2 * apart];
        const Real d = omega[i], e = omega[i + apart], f = omega[i + 2 * apart];
        out[i] = b * f - c * e;
        out[i + out_apart] = c * d - a * f;
        out[i + 2 * out_apart] = a * e - b * d;
    }
}

// Call function(line, z, y) for all lines of modes along x, in parallel.
template <typename Function>
void for_lines(const Modes& modes, const Function& function) {
    const Int planes = 2 * modes.cutoff + 1;
#pragma omp parallel for schedule(static) if (planes * modes.lines * modes.cutoff > FEW)
    for (Int line = 0; line < planes * modes.lines; ++line)
        function(line, line / modes.lines, line % modes.lines);
}

template <typename Real>
void project(const Modes& modes, const Real* vector, Real* result) {
    const Int width = modes.cutoff + 1, size = 2 * (2 * modes.cutoff + 1) * modes.lines * width;
    for_lines(modes, [&](Int line, Int z, Int y) {
        const Real* const kx = static_cast<const Real*>(modes.kx);
        const Real ky = static_cast<const Real*>(modes.ky)[y], kz = static_cast<const Real*>(modes.kz)[z];
        const Real* const from = vector + 2 * line * width;
        Real* const to = result + 2 * line * width;
#pragma omp simd
        for (Int x = 0; x < width; ++x) {
            const Real squared = kx[x] * kx[x] + ky * ky + kz * kz;
            const Real inverse = squared > 0 ? 1 / squared : 0;
            for (Int i = 2 * x; i < 2 * x + 2; ++i) {
                const Real a = from[i], b = from[i + size], c = from[i + 2 * size];
                const Real along = (kx[x] * a + ky * b + kz * c) * inverse;
                to[i] = a - kx[x] * along;
                to[i + size] = b - ky * along;
                to[i + 2 * size] = c - kz * along;
            }
        }
    });
}

// Number of the line of factors for a line of modes. Factors are stored for |kz| only.
inline Int line_of_factors(const Modes& modes, Int z, Int y) {
    return std::min(z, 2 * modes.cutoff + 1 - z) * modes.lines + y;
}

template <typename Real>
void decays(const Modes& modes, Int components, Int terms, const Real* const* factors, const Real* const* states,
            Real* result) {
    const Int width = modes.cutoff + 1, size = 2 * (2 * modes.cutoff + 1) * modes.lines * width;
    for_lines(modes, [&](Int line, Int z, Int y) {
        const Int at = line_of_factors(modes, z, y) * width;
        for (Int component = 0; component < components; ++component) {
            const Int start = component * size + 2 * line * width;
            Real* const to = result + start;
            std::fill(to, to + 2 * width, Real(0));
            for (Int term = 0; term < terms; ++term) {
                const Real *const factor = factors[term] + at, *const from = states[term] + start;
#pragma omp simd
                for (Int x = 0; x < width; ++x) {
                    to[2 * x] += factor[x] * from[2 * x];
                    to[2 * x + 1] += factor[x] * from[2 * x + 1];
                }
            }
        }
    });
}

// Add the map of a state (u, sigma), sigma = -i s, along a line: u becomes transverse u + k (excess k.u + elastic
// sigma), sigma becomes identity sigma - coupling k.u. `along` gets the factor of k, `sums` the rest. Components of the
// state are `size` numbers apart.
template <typename Real>
void add_acoustic_block(Int width, Int size, const Real* __restrict factors, const Real* __restrict state,
                        const Real* __restrict kx, Real ky, Real kz, Real* __restrict sums, Real* __restrict along) {
#pragma omp simd
    for (Int x = 0; x < width; ++x) {
        const Real transverse = factors[x], excess = factors[x + width], elastic = factors[x + 2 * width];
        const Real identity = factors[x + 3 * width], coupling = factors[x + 4 * width];
        const Real ur = state[2 * x], ui = state[2 * x + 1];
        const Real vr = state[2 * x + size], vi = state[2 * x + 1 + size];
        const Real wr = state[2 * x + 2 * size], wi = state[2 * x + 1 + 2 * size];
        const Real sr = state[2 * x + 1 + 3 * size], si = -state[2 * x + 3 * size];  // sigma = -i s
        const Real dotted_r = kx[x] * ur + ky * vr + kz * wr, dotted_i = kx[x] * ui + ky * vi + kz * wi;
        sums[x] += transverse * ur;
        sums[x + width] += transverse * ui;
        sums[x + 2 * width] += transverse * vr;
        sums[x + 3 * width] += transverse * vi;
        sums[x + 4 * width] += transverse * wr;
        sums[x + 5 * width] += transverse * wi;
        sums[x + 6 * width] += identity * sr - coupling * dotted_r;
        sums[x + 7 * width] += identity * si - coupling * dotted_i;
        along[x] += excess * dotted_r + elastic * sr;
        along[x + width] += excess * dotted_i + elastic * si;
    }
}

template <typename Real>
void acoustic_blocks(const Modes& modes, Int terms, const Real* const* factors, const Real* const* states,
                     Real* result) {
    const Int width = modes.cutoff + 1, size = 2 * (2 * modes.cutoff + 1) * modes.lines * width;
    for_lines(modes, [&](Int line, Int z, Int y) {
        // Sums of (u, v, w, sigma) along the line, and the factor of k. Real and imaginary parts are separate.
        thread_local std::vector<Real> memory;
        memory.assign(10 * width, 0);
        Real *const sums = memory.data(), *const along = sums + 8 * width;
        const Real* const kx = static_cast<const Real*>(modes.kx);
        const Real ky = static_cast<const Real*>(modes.ky)[y], kz = static_cast<const Real*>(modes.kz)[z];
        for (Int term = 0; term < terms; ++term)
            add_acoustic_block(width, size, factors[term] + 5 * line_of_factors(modes, z, y) * width,
                               states[term] + 2 * line * width, kx, ky, kz, sums, along);
        Real* __restrict const to = result + 2 * line * width;
#pragma omp simd
        for (Int x = 0; x < width; ++x) {
            const Real real = along[x], imaginary = along[x + width];
            to[2 * x] = sums[x] + kx[x] * real;
            to[2 * x + 1] = sums[x + width] + kx[x] * imaginary;
            to[2 * x + size] = sums[x + 2 * width] + ky * real;
            to[2 * x + 1 + size] = sums[x + 3 * width] + ky * imaginary;
            to[2 * x + 2 * size] = sums[x + 4 * width] + kz * real;
            to[2 * x + 1 + 2 * size] = sums[x + 5 * width] + kz * imaginary;
            to[2 * x + 3 * size] = -sums[x + 7 * width];
            to[2 * x + 1 + 3 * size] = sums[x + 6 * width];
        }
    });
}

}  // namespace

// All functions for one precision, as kernels/flow.py calls them.
#define FLOW(Real, precision)                                                                                        \
    void flow_advection_##precision(Int points, Int apart, const Real* fields, double viscosity, Int out_apart,      \
                                    Real* out) {                                                                     \
        (viscosity > 0 ? advection<Real, true> : advection<Real, false>)(points, apart, fields,                      \
                                                                         static_cast<Real>(viscosity), out_apart,    \
                                                                         out);                                       \
    }                                                                                                                \
    void flow_cross_##precision(Int points, Int apart, const Real* fields, Int out_apart, Real* out) {               \
        cross(points, apart, fields, out_apart, out);                                                                \
    }                                                                                                                \
    void flow_project_##precision(const Modes* modes, const Real* vector, Real* result) {                            \
        project(*modes, vector, result);                                                                             \
    }                                                                                                                \
    void flow_decays_##precision(const Modes* modes, Int components, Int terms, const Real* const* factors,          \
                                 const Real* const* states, Real* result) {                                          \
        decays(*modes, components, terms, factors, states, result);                                                  \
    }                                                                                                                \
    void flow_acoustic_blocks_##precision(const Modes* modes, Int terms, const Real* const* factors,                 \
                                          const Real* const* states, Real* result) {                                 \
        acoustic_blocks(*modes, terms, factors, states, result);                                                     \
    }

extern "C" {

FLOW(double, float64)
FLOW(float, float32)

}  // extern "C"
