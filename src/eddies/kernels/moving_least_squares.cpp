// Moving least squares: the polynomial of first or second degree that best fits the values of the particles around a
// receiver, weighted by a smoothing kernel. `ParticleField.fitted` in particles/particle_field.py has the equation.

#include <algorithm>
#include <cmath>
#include <cstdint>

#include "smoothing.hpp"

extern "C" {

// Receivers, and in compressed rows the particles near each receiver. Some of these particles may be beyond the
// kernel's support. kernels/reconstruction.py has the same structure.
struct Fit {
    std::int64_t receivers, periodic_z;
    double length, volume, ridge;     // edge of the box; mean volume of a particle; see the equation
    const std::int64_t *offsets, *senders;
    const double *receiver, *position, *value, *kernel;  // (receivers, 3), (s, 3), (s, 3); kernel: see smoothing.hpp
    double *result;                   // (receivers, 4, 3): value, and its derivatives by x, y and z
};

}  // extern "C"

namespace {

using Int = std::int64_t;
using V = eddies::Vector<double>;
constexpr int lanes = eddies::VectorOf<double>::lanes;

// The monomials 1, x, y, z and, for the second degree, xx, xy, xz, yy, yz, zz.
template <int SIZE>
void monomials(const V* x, V* terms) {
    terms[0] = V{} + 1;
    for (int axis = 0; axis < 3; ++axis) terms[1 + axis] = x[axis];
    if constexpr (SIZE > 4)
        for (int i = 0, k = 4; i < 3; ++i)
            for (int j = i; j < 3; ++j) terms[k++] = x[i] * x[j];
}

double sum_of_lanes(V numbers) {
    double sum = 0;
    for (int lane = 0; lane < lanes; ++lane) sum += numbers[lane];
    return sum;
}

// The normal equations of one receiver, and their solution. The sums take a vector of neighbours at a time.
template <int SIZE>
class Normal {
   public:
    explicit Normal(const Fit& f) : f_(f), kernel_(f.kernel), reach_(f.kernel[0]) {}

    void solve(Int receiver) {
        sum_up(receiver);
        double* result = f_.result + 12 * receiver;
        if (!factorise()) {
            std::fill_n(result, 12, 0.0);
            return;
        }
        for (int c = 0; c < 3; ++c) {
            substitute(right_[c]);
            for (int k = 0; k < 4; ++k) result[3 * k + c] = right_[c][k] / (k ? reach_ : 1.0);
        }
    }

   private:
    const Fit& f_;
    const eddies::Smoothing<double> kernel_;
    const double reach_;
    double matrix_[SIZE][SIZE], right_[3][SIZE];

    void sum_up(Int receiver) {
        V matrix[SIZE][SIZE] = {}, right[3][SIZE] = {};
        const Int begin = f_.offsets[receiver], end = f_.offsets[receiver + 1];
        for (Int pair = begin; pair < end; pair += lanes) {
            V x[3], value[3], square{};
            read(receiver, pair, std::min<Int>(lanes, end - pair), x, value);
            for (int axis = 0; axis < 3; ++axis) square += x[axis] * x[axis];
            V distance;
            for (int lane = 0; lane < lanes; ++lane) distance[lane] = std::sqrt(square[lane]);
            const V weight = distance < reach_ ? kernel_.value(distance) * f_.volume : V{};
            for (int axis = 0; axis < 3; ++axis) x[axis] /= reach_;
            V m[SIZE];
            monomials<SIZE>(x, m);
            for (int i = 0; i < SIZE; ++i) {
                const V weighted = weight * m[i];
                for (int j = 0; j <= i; ++j) matrix[i][j] += weighted * m[j];
                for (int c = 0; c < 3; ++c) right[c][i] += weighted * value[c];
            }
        }
        for (int i = 0; i < SIZE; ++i) {
            for (int j = 0; j <= i; ++j) matrix_[i][j] = sum_of_lanes(matrix[i][j]);
            if (i) matrix_[i][i] += f_.ridge;
            for (int c = 0; c < 3; ++c) right_[c][i] = sum_of_lanes(right[c][i]);
        }
    }

    // Read displacements and values of a vector of neighbours. A lane without one gets a distance beyond the support.
    void read(Int receiver, Int pair, Int count, V* x, V* value) const {
        for (int lane = 0; lane < lanes; ++lane) {
            const Int sender = f_.senders[lane < count ? pair + lane : pair];
            for (int axis = 0; axis < 3; ++axis) {
                double apart = f_.position[3 * sender + axis] - f_.receiver[3 * receiver + axis];
                if (axis < 2 || f_.periodic_z) apart -= f_.length * std::nearbyint(apart / f_.length);
                x[axis][lane] = lane < count ? apart : 2 * reach_;
                value[axis][lane] = f_.value[3 * sender + axis];
            }
        }
    }

    // Replace the matrix by its Cholesky factor. Returns whether the factor exists. It does if a weight is not zero and
    // there is a ridge.
    bool factorise() {
        for (int j = 0; j < SIZE; ++j) {
            for (int k = 0; k < j; ++k) matrix_[j][j] -= matrix_[j][k] * matrix_[j][k];
            if (!(matrix_[j][j] > 0)) return false;
            matrix_[j][j] = std::sqrt(matrix_[j][j]);
            for (int i = j + 1; i < SIZE; ++i) {
                for (int k = 0; k < j; ++k) matrix_[i][j] -= matrix_[i][k] * matrix_[j][k];
                matrix_[i][j] /= matrix_[j][j];
            }
        }
        return true;
    }

    void substitute(double* right) const {
        for (int i = 0; i < SIZE; ++i) {
            for (int k = 0; k < i; ++k) right[i] -= matrix_[i][k] * right[k];
            right[i] /= matrix_[i][i];
        }
        for (int i = SIZE - 1; i >= 0; --i) {
            for (int k = i + 1; k < SIZE; ++k) right[i] -= matrix_[k][i] * right[k];
            right[i] /= matrix_[i][i];
        }
    }
};

template <int SIZE>
void fit(const Fit& f) {
#pragma omp parallel
    {
        Normal<SIZE> normal(f);
#pragma omp for schedule(static)
        for (Int receiver = 0; receiver < f.receivers; ++receiver) normal.solve(receiver);
    }
}

}  // namespace

extern "C" {

void fit_linear(const Fit* f) { fit<4>(*f); }

void fit_quadratic(const Fit* f) { fit<10>(*f); }

}  // extern "C"
