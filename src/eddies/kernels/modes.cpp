// Loops over the Fourier modes of a vector field, for conjugate gradients on solenoidal modes. Each reads and writes
// the memory once. kernels/modes.py documents them. Sums are in double precision: first over each plane, then over the
// planes in order. So no result depends on the number of threads.

#include <cstdint>
#include <vector>

namespace {

// Real weights of the modes, for each mode (z, y, x) or along an axis. kernels/modes.py has the same structure.
template <typename Real>
struct Weights {
    std::int64_t z, y, x;
    const Real *kx, *ky, *kz;
    const Real* multiplicity;     // (x), number of times that a stored mode counts in the full sum
    const Real* inverse_squared;  // 1/k^2, 0 for k = 0
    const Real* scale;            // factor of the projected vector; 0 for modes that are not solved for
    const Real* penalty;
};

// Sum of function(z, y, start) over all lines along x; `start` is the index of a line's first number in the weights.
template <typename Real, typename Function>
double sum_over_lines(const Weights<Real>& weights, const Function& function) {
    std::vector<double> sums(weights.z);
#pragma omp parallel for schedule(static)
    for (std::int64_t z = 0; z < weights.z; ++z)
        for (std::int64_t y = 0; y < weights.y; ++y) sums[z] += function(z, y, (z * weights.y + y) * weights.x);
    double sum = 0.0;
    for (const double part : sums) sum += part;
    return sum;
}

// Set image = P (scale given) + penalty modes, where P projects on solenoidal fields. Returns this rank's sum of modes
// times image. Vectors are (3, z, y, x) of complex numbers.
template <typename Real>
double image_of(const Weights<Real>& w, const Real* given, const Real* modes, Real* image) {
    const std::int64_t size = 2 * w.z * w.y * w.x;
    return sum_over_lines(w, [&](std::int64_t z, std::int64_t y, std::int64_t start) {
        double sum = 0.0;
        const Real ky = w.ky[y], kz = w.kz[z];
#pragma omp simd reduction(+ : sum)
        for (std::int64_t x = 0; x < w.x; ++x) {
            const std::int64_t at = start + x;
            const Real kx = w.kx[x], scale = w.scale[at], penalty = w.penalty[at];
            const Real along = scale * w.inverse_squared[at];
            Real product = 0;
            for (int part = 0; part < 2; ++part) {
                const std::int64_t i = 2 * at + part;
                const Real a = given[i], b = given[i + size], c = given[i + 2 * size];
                const Real longitudinal = along * (kx * a + ky * b + kz * c);
                const Real p = modes[i], q = modes[i + size], r = modes[i + 2 * size];
                const Real d = scale * a - kx * longitudinal + penalty * p;
                const Real e = scale * b - ky * longitudinal + penalty * q;
                const Real f = scale * c - kz * longitudinal + penalty * r;
                image[i] = d;
                image[i + size] = e;
                image[i + 2 * size] = f;
                product += p * d + q * e + r * f;
            }
            sum += w.multiplicity[x] * product;
        }
        return sum;
    });
}

// solution += length direction, residual -= length image. Returns this rank's sum of inverse times the new residual
// squared.
template <typename Real>
double descend(const Weights<Real>& w, Real length, const Real* inverse, const Real* direction, const Real* image,
               Real* solution, Real* residual) {
    const std::int64_t size = 2 * w.z * w.y * w.x;
    return sum_over_lines(w, [&](std::int64_t, std::int64_t, std::int64_t start) {
        double sum = 0.0;
        for (int component = 0; component < 3; ++component) {
            const std::int64_t first = component * size + 2 * start;
#pragma omp simd reduction(+ : sum)
            for (std::int64_t x = 0; x < w.x; ++x) {
                const std::int64_t i = first + 2 * x;
                const Real real = residual[i] - length * image[i], imaginary = residual[i + 1] - length * image[i + 1];
                solution[i] += length * direction[i];
                solution[i + 1] += length * direction[i + 1];
                residual[i] = real;
                residual[i + 1] = imaginary;
                sum += w.multiplicity[x] * inverse[start + x] * (real * real + imaginary * imaginary);
            }
        }
        return sum;
    });
}

// direction = inverse residual + share direction.
template <typename Real>
void turn(const Weights<Real>& w, Real share, const Real* inverse, const Real* residual, Real* direction) {
    const std::int64_t plane = w.y * w.x;
#pragma omp parallel for schedule(static)
    for (std::int64_t z = 0; z < 3 * w.z; ++z) {
        const Real* weight = inverse + z % w.z * plane;
#pragma omp simd
        for (std::int64_t i = 0; i < plane; ++i) {
            const std::int64_t at = 2 * (z * plane + i);
            direction[at] = weight[i] * residual[at] + share * direction[at];
            direction[at + 1] = weight[i] * residual[at + 1] + share * direction[at + 1];
        }
    }
}

}  // namespace

#define FOR_PRECISION(Real, name)                                                                                      \
    double modes_image_##name(const Weights<Real>* weights, const Real* given, const Real* modes, Real* image) {       \
        return image_of(*weights, given, modes, image);                                                                \
    }                                                                                                                  \
    double modes_descend_##name(const Weights<Real>* weights, double length, const Real* inverse,                      \
                                const Real* direction, const Real* image, Real* solution, Real* residual) {            \
        return descend(*weights, static_cast<Real>(length), inverse, direction, image, solution, residual);            \
    }                                                                                                                  \
    void modes_turn_##name(const Weights<Real>* weights, double share, const Real* inverse, const Real* residual,      \
                           Real* direction) {                                                                          \
        turn(*weights, static_cast<Real>(share), inverse, residual, direction);                                        \
    }

extern "C" {

FOR_PRECISION(double, float64)
FOR_PRECISION(float, float32)

}  // extern "C"
