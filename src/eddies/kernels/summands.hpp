// What is summed over pairs of particles: the terms of eddies/particles/terms, which are the definitions.

#pragma once

#include <memory>

#include "network.hpp"
#include "smoothing.hpp"

namespace eddies {

constexpr int MOST_SCALARS = 4;     // columns of numbers that particles carry
constexpr int MOST_COMPONENTS = 16;  // of what one summand gives

// Pairs: the separation in filter widths and the velocity difference in units of the velocity, first less second
// particle; length of the separation, weight (1 - q^2)^2, and numbers of first and second.
template <typename Real>
struct Block {
    alignas(64) Real x[3][BLOCK], v[3][BLOCK], distance[BLOCK], weight[BLOCK];
    const Real* scalar[2][MOST_SCALARS];
};

// The gradient by these, zero at first; those by separation, velocity difference and numbers stand in rows as records
// of first and second particles have them.
template <typename Real>
struct ByPairs {
    int width;
    Rows<Real> first, second;
    alignas(64) Real distance[BLOCK], weight[BLOCK];
    Real *x[3], *v[3], *scalar[2][MOST_SCALARS];

    explicit ByPairs(int width) : width(width), first(width), second(width) {
        for (int axis = 0; axis < 3; ++axis) {
            x[axis] = first[axis];
            v[axis] = first[3 + axis];
        }
        for (int s = 0; s < std::min(MOST_SCALARS, width - 6); ++s) {
            scalar[0][s] = first[6 + s];
            scalar[1][s] = second[6 + s];
        }
    }

    void clear() {
        std::fill_n(first[0], width * BLOCK, Real(0));
        std::fill_n(second[0], width * BLOCK, Real(0));
        std::fill_n(distance, BLOCK, Real(0));
        std::fill_n(weight, BLOCK, Real(0));
    }
};

// Rows of components.
template <typename Real>
using Components = Real (*)[BLOCK];

template <typename Real>
using GivenComponents = const Real (*)[BLOCK];

// `mutual`: what the second particle gets of the first is what that gets times `parity` of each component.
template <typename Real>
class Summand {
   public:
    int components;
    Real parity[MOST_COMPONENTS];

    Summand(int components, Real all) : components(components) {
        for (Real& one : parity) one = all;
    }
    virtual ~Summand() = default;

    // Components of pairs.
    virtual void values(const Block<Real>& pairs, Components<Real> found) = 0;

    // From the gradient by components: to be added to that by what the pairs carry, unless that is null, and to that by
    // parameters, a vector for each.
    virtual void gradients(const Block<Real>& pairs, GivenComponents<Real> given, ByPairs<Real>* by_pairs,
                           Real* by_parameters) = 0;
};

// One lane after the other, for the compiler to take several together.
#define EDDIES_PAIRS _Pragma("omp simd") for (int p = 0; p < BLOCK; ++p)

// Of two vectors of a pair.
template <typename Real>
inline Real dot(const Real (*a)[BLOCK], const Real (*b)[BLOCK], int p) {
    return a[0][p] * b[0][p] + a[1][p] * b[1][p] + a[2][p] * b[2][p];
}

// w NN_1 x and w NN_2 v, or with one output w NN, of a network of the pairs' invariants.
template <typename Real>
class PairNetwork : public Summand<Real> {
   public:
    // Options: outputs, whether densities enter as sum and square of the difference, whether the network is told
    // density (the scalar), distance, speed, approach; widths of hidden layers.
    PairNetwork(const std::int64_t* options, int count, int scalar, const double* parameters)
        : Summand<Real>(options[0] == 2 ? 6 : 1, Real(options[0] == 2 ? -1 : 1)),
          symmetric_(options[1]), density_(options[2] ? scalar : -1), distance_(options[3]), speed_(options[4]),
          approach_(options[5]), network_(widths(options, count), parameters) {}

    void values(const Block<Real>& pairs, Components<Real> found) override {
        evaluate(pairs);
        const Rows<Real>& outputs = network_.outputs();
        const Real *along_x = outputs[0], *w = pairs.weight;
        if (this->components == 1) {
            EDDIES_PAIRS found[0][p] = w[p] * along_x[p];
            return;
        }
        const Real* along_v = outputs[1];
        for (int c = 0; c < 3; ++c) {
            EDDIES_PAIRS found[c][p] = w[p] * along_x[p] * pairs.x[c][p];
            EDDIES_PAIRS found[3 + c][p] = w[p] * along_v[p] * pairs.v[c][p];
        }
    }

    void gradients(const Block<Real>& pairs, GivenComponents<Real> given, ByPairs<Real>* by_pairs,
                   Real* by_parameters) override {
        evaluate(pairs);
        const Real* w = pairs.weight;
        Rows<Real>& by_outputs = network_.by_outputs();
        if (this->components == 1) {
            EDDIES_PAIRS by_outputs[0][p] = w[p] * given[0][p];
        } else {
            Real *by_x = by_outputs[0], *by_v = by_outputs[1];
            EDDIES_PAIRS by_x[p] = w[p] * dot(given, pairs.x, p);
            EDDIES_PAIRS by_v[p] = w[p] * dot(given + 3, pairs.v, p);
        }
        network_.backward(by_parameters, by_pairs != nullptr);
        if (by_pairs) add_by_pairs(pairs, given, *by_pairs);
    }

   private:
    bool symmetric_;
    int density_;
    bool distance_, speed_, approach_;
    Network<Real> network_;
    alignas(64) Real speed_of_[BLOCK];

    static std::vector<int> widths(const std::int64_t* options, int count) {
        std::vector<int> found(1, static_cast<int>(2 * options[2] + options[3] + options[4] + options[5]));
        found.insert(found.end(), options + 6, options + count);
        found.push_back(static_cast<int>(options[0]));
        return found;
    }

    void evaluate(const Block<Real>& pairs) {
        Rows<Real>& features = network_.features();
        int row = 0;
        if (density_ >= 0) {
            const Real *own = pairs.scalar[0][density_], *other = pairs.scalar[1][density_];
            Real *first = features[row++], *second = features[row++];
            if (symmetric_) {
                EDDIES_PAIRS {
                    first[p] = own[p] + other[p];
                    second[p] = (own[p] - other[p]) * (own[p] - other[p]);
                }
            } else {
                std::copy(own, own + BLOCK, first);
                std::copy(other, other + BLOCK, second);
            }
        }
        if (distance_) std::copy(pairs.distance, pairs.distance + BLOCK, features[row++]);
        if (speed_) {
            EDDIES_PAIRS speed_of_[p] = std::sqrt(dot(pairs.v, pairs.v, p));
            std::copy(speed_of_, speed_of_ + BLOCK, features[row++]);
        }
        if (approach_) {
            Real* feature = features[row];
            EDDIES_PAIRS feature[p] = dot(pairs.x, pairs.v, p);
        }
        network_.forward();
    }

    void add_by_pairs(const Block<Real>& pairs, GivenComponents<Real> given, ByPairs<Real>& by) {
        const Rows<Real>&by_features = network_.by_features(), &outputs = network_.outputs();
        const Real *w = pairs.weight, *along_x = outputs[0];
        if (this->components == 1) {
            EDDIES_PAIRS by.weight[p] += given[0][p] * along_x[p];
        } else {
            const Real* along_v = outputs[1];
            for (int c = 0; c < 3; ++c) EDDIES_PAIRS {
                    by.weight[p] += given[c][p] * along_x[p] * pairs.x[c][p];
                    by.weight[p] += given[3 + c][p] * along_v[p] * pairs.v[c][p];
                    by.x[c][p] += given[c][p] * w[p] * along_x[p];
                    by.v[c][p] += given[3 + c][p] * w[p] * along_v[p];
                }
        }
        int row = 0;
        if (density_ >= 0) {
            const Real *own = pairs.scalar[0][density_], *other = pairs.scalar[1][density_];
            const Real *first = by_features[row++], *second = by_features[row++];
            Real *by_own = by.scalar[0][density_], *by_other = by.scalar[1][density_];
            const Real symmetric = symmetric_ ? 1 : 0;
            EDDIES_PAIRS {
                const Real turned = symmetric * 2 * (own[p] - other[p]) * second[p];
                by_own[p] += first[p] + turned;
                by_other[p] += symmetric * first[p] - turned + (1 - symmetric) * second[p];
            }
        }
        if (distance_) {
            const Real* feature = by_features[row++];
            EDDIES_PAIRS by.distance[p] += feature[p];
        }
        if (speed_) {
            const Real* feature = by_features[row++];
            for (int c = 0; c < 3; ++c)
                EDDIES_PAIRS by.v[c][p] += speed_of_[p] > 0 ? feature[p] * pairs.v[c][p] / speed_of_[p] : Real(0);
        }
        if (approach_) {
            const Real* feature = by_features[row];
            for (int c = 0; c < 3; ++c) EDDIES_PAIRS {
                    by.x[c][p] += feature[p] * pairs.v[c][p];
                    by.v[c][p] += feature[p] * pairs.x[c][p];
                }
        }
    }
};

// w, and the entries xx, xy, xz, yy, yz, zz of w x x^T.
template <typename Real>
class Moments : public Summand<Real> {
   public:
    Moments() : Summand<Real>(7, Real(1)) {}

    void values(const Block<Real>& pairs, Components<Real> found) override {
        const auto& x = pairs.x;
        EDDIES_PAIRS {
            const Real w = pairs.weight[p], wx = w * x[0][p], wy = w * x[1][p];
            found[0][p] = w;
            found[1][p] = wx * x[0][p];
            found[2][p] = wx * x[1][p];
            found[3][p] = wx * x[2][p];
            found[4][p] = wy * x[1][p];
            found[5][p] = wy * x[2][p];
            found[6][p] = w * x[2][p] * x[2][p];
        }
    }

    void gradients(const Block<Real>& pairs, GivenComponents<Real> given, ByPairs<Real>* by, Real*) override {
        if (!by) return;
        EDDIES_PAIRS {
            const Real x = pairs.x[0][p], y = pairs.x[1][p], z = pairs.x[2][p], w = pairs.weight[p];
            const Real xx = given[1][p], xy = given[2][p], xz = given[3][p], yy = given[4][p], yz = given[5][p],
                       zz = given[6][p];
            const Real dx = 2 * xx * x + xy * y + xz * z, dy = xy * x + 2 * yy * y + yz * z,
                       dz = xz * x + yz * y + 2 * zz * z;
            by->weight[p] += given[0][p] + (x * dx + y * dy + z * dz) / 2;
            by->x[0][p] += w * dx;
            by->x[1][p] += w * dy;
            by->x[2][p] += w * dz;
        }
    }
};

// w Pi x with Pi = mu (|a_2| mu - |a_1|), mu = x.v / (|x|^2 + softening); or of approaching pairs alone.
template <typename Real>
class EddyViscosity : public Summand<Real> {
   public:
    EddyViscosity(bool approaching, const double* constants, const double* parameters)
        : Summand<Real>(3, Real(-1)), approaching_(approaching), softening_(constants[0]), linear_(parameters[0]),
          quadratic_(parameters[1]) {}

    void values(const Block<Real>& pairs, Components<Real> found) override {
        EDDIES_PAIRS {
            const Real mu = rate(pairs, p), strength = pairs.weight[p] * mu * (quadratic_ * mu - linear_);
            for (int c = 0; c < 3; ++c) found[c][p] = strength * pairs.x[c][p];
        }
    }

    void gradients(const Block<Real>& pairs, GivenComponents<Real> given, ByPairs<Real>* by,
                   Real* by_parameters) override {
        alignas(64) Real by_linear[BLOCK], by_quadratic[BLOCK];
        EDDIES_PAIRS {
            const Real x = pairs.x[0][p], y = pairs.x[1][p], z = pairs.x[2][p], w = pairs.weight[p];
            const Real along = given[0][p] * x + given[1][p] * y + given[2][p] * z, mu = rate(pairs, p);
            by_linear[p] = -w * along * mu;
            by_quadratic[p] = w * along * mu * mu;
        }
        add_lanes(by_linear, by_parameters);
        add_lanes(by_quadratic, by_parameters + VectorOf<Real>::lanes);
        if (!by) return;
        EDDIES_PAIRS {
            const Real r = pairs.distance[p], w = pairs.weight[p], mu = rate(pairs, p);
            const Real below = 1 / (r * r + softening_);
            const Real strength = mu * (quadratic_ * mu - linear_);
            const Real along = dot(given, pairs.x, p);
            const Real by_mu = approaching_ && mu >= 0 ? Real(0) : w * along * (2 * quadratic_ * mu - linear_);
            by->weight[p] += along * strength;
            by->distance[p] -= by_mu * mu * 2 * r * below;
            for (int c = 0; c < 3; ++c) {
                by->x[c][p] += w * strength * given[c][p] + by_mu * below * pairs.v[c][p];
                by->v[c][p] += by_mu * below * pairs.x[c][p];
            }
        }
    }

   private:
    bool approaching_;
    Real softening_, linear_, quadratic_;

    Real rate(const Block<Real>& pairs, int p) const {
        const Real r = pairs.distance[p];
        const Real mu = dot(pairs.x, pairs.v, p) /
                        (r * r + softening_);
        return approaching_ && mu > 0 ? Real(0) : mu;
    }
};

// The entries of w (x v^T + v x^T)/2, and w (rho'_j - rho'_i).
template <typename Real>
class DensityTransport : public Summand<Real> {
   public:
    explicit DensityTransport(int density) : Summand<Real>(7, Real(1)), density_(density) { this->parity[6] = -1; }

    void values(const Block<Real>& pairs, Components<Real> found) override {
        const auto &x = pairs.x, &v = pairs.v;
        const Real *own = pairs.scalar[0][density_], *other = pairs.scalar[1][density_];
        EDDIES_PAIRS {
            const Real w = pairs.weight[p], half = w / 2;
            found[0][p] = w * x[0][p] * v[0][p];
            found[1][p] = half * (x[0][p] * v[1][p] + x[1][p] * v[0][p]);
            found[2][p] = half * (x[0][p] * v[2][p] + x[2][p] * v[0][p]);
            found[3][p] = w * x[1][p] * v[1][p];
            found[4][p] = half * (x[1][p] * v[2][p] + x[2][p] * v[1][p]);
            found[5][p] = w * x[2][p] * v[2][p];
            found[6][p] = w * (other[p] - own[p]);
        }
    }

    void gradients(const Block<Real>& pairs, GivenComponents<Real> given, ByPairs<Real>* by, Real*) override {
        if (!by) return;
        const auto &x = pairs.x, &v = pairs.v;
        const Real *own = pairs.scalar[0][density_], *other = pairs.scalar[1][density_];
        EDDIES_PAIRS {
            const Real w = pairs.weight[p];
            const Real xx = given[0][p], xy = given[1][p] / 2, xz = given[2][p] / 2, yy = given[3][p],
                       yz = given[4][p] / 2, zz = given[5][p];
            // The symmetric matrix of the gradient times x, and times v.
            const Real x0 = xx * x[0][p] + xy * x[1][p] + xz * x[2][p], x1 = xy * x[0][p] + yy * x[1][p] + yz * x[2][p],
                       x2 = xz * x[0][p] + yz * x[1][p] + zz * x[2][p];
            const Real v0 = xx * v[0][p] + xy * v[1][p] + xz * v[2][p], v1 = xy * v[0][p] + yy * v[1][p] + yz * v[2][p],
                       v2 = xz * v[0][p] + yz * v[1][p] + zz * v[2][p];
            by->weight[p] += v[0][p] * x0 + v[1][p] * x1 + v[2][p] * x2 + given[6][p] * (other[p] - own[p]);
            by->x[0][p] += w * v0;
            by->x[1][p] += w * v1;
            by->x[2][p] += w * v2;
            by->v[0][p] += w * x0;
            by->v[1][p] += w * x1;
            by->v[2][p] += w * x2;
            by->scalar[0][density_][p] -= w * given[6][p];
            by->scalar[1][density_][p] += w * given[6][p];
        }
    }

   private:
    int density_;
};

// Kernels of smoothed particle hydrodynamics as functions of q = r/h <= 1, and their slopes over q: W h^3, W'/q h^4.
template <typename Real>
struct SmoothingKernel {
    bool wendland;

    Real value(Real q) const {
        const Real left = 1 - q;
        if (wendland) return Real(21 / (2 * M_PI)) * left * left * left * left * (1 + 4 * q);
        return Real(8 / M_PI) * (q < Real(0.5) ? 1 - 6 * q * q * left : 2 * left * left * left);
    }

    Real slope_over_q(Real q) const {
        const Real left = 1 - q;
        if (wendland) return Real(-210 / M_PI) * left * left * left;
        return Real(48 / M_PI) * (q < Real(0.5) ? 3 * q - 2 : -left * left / (q > 0 ? q : Real(1)));
    }

    // Derivative of that by q.
    Real bend(Real q) const {
        const Real left = 1 - q;
        if (wendland) return Real(630 / M_PI) * left * left;
        return Real(48 / M_PI) * (q < Real(0.5) ? 3 : (1 - q * q) / (q > 0 ? q * q : Real(1)));
    }
};

// W of the distance, in units of `constants`: the distance at which it ends, in filter widths, and W h^3 to W.
template <typename Real>
class SummationDensity : public Summand<Real> {
   public:
    SummationDensity(bool wendland, const double* constants)
        : Summand<Real>(1, Real(1)), kernel_{wendland}, support_(constants[0]), unit_(constants[1]) {}

    void values(const Block<Real>& pairs, Components<Real> found) override {
        EDDIES_PAIRS found[0][p] = unit_ * kernel_.value(pairs.distance[p] / support_);
    }

    void gradients(const Block<Real>& pairs, GivenComponents<Real> given, ByPairs<Real>* by, Real*) override {
        if (!by) return;
        EDDIES_PAIRS {
            const Real q = pairs.distance[p] / support_;
            by->distance[p] += given[0][p] * unit_ / support_ * kernel_.slope_over_q(q) * q;
        }
    }

   private:
    SmoothingKernel<Real> kernel_;
    Real support_, unit_;
};

// -(P_i/rho_i^2 + P_j/rho_j^2 + Pi) W'/r x of weakly compressible smoothed particle hydrodynamics, in filter widths and
// units of the velocity. Parameters: alpha c and beta of Pi. Constants: the distance at which W ends, the unit of the
// result, and the softening. Two scalars: P/rho^2 and rho.
template <typename Real>
class Wcsph : public Summand<Real> {
   public:
    Wcsph(bool wendland, int scalar, const double* constants, const double* parameters)
        : Summand<Real>(3, Real(-1)), kernel_{wendland}, push_(scalar), density_(scalar + 1),
          support_(constants[0]), unit_(constants[1]), softening_(constants[2]),
          linear_(parameters[0]), quadratic_(parameters[1]) {}

    void values(const Block<Real>& pairs, Components<Real> found) override {
        EDDIES_PAIRS {
            const Real strength = -unit_ * total(pairs, p) * kernel_.slope_over_q(pairs.distance[p] / support_);
            for (int c = 0; c < 3; ++c) found[c][p] = strength * pairs.x[c][p];
        }
    }

    void gradients(const Block<Real>& pairs, GivenComponents<Real> given, ByPairs<Real>* by,
                   Real* by_parameters) override {
        alignas(64) Real by_linear[BLOCK], by_quadratic[BLOCK], by_total[BLOCK];
        EDDIES_PAIRS {
            const Real slope = -unit_ * kernel_.slope_over_q(pairs.distance[p] / support_), mu = rate(pairs, p);
            const Real along = dot(given, pairs.x, p);
            by_total[p] = along * slope;
            by_linear[p] = -by_total[p] * mu / mean(pairs, p);
            by_quadratic[p] = by_total[p] * mu * mu / mean(pairs, p);
        }
        add_lanes(by_linear, by_parameters);
        add_lanes(by_quadratic, by_parameters + VectorOf<Real>::lanes);
        if (!by) return;
        EDDIES_PAIRS {
            const Real r = pairs.distance[p], q = r / support_, mu = rate(pairs, p), average = mean(pairs, p);
            const Real along = dot(given, pairs.x, p);
            const Real slope = -unit_ * kernel_.slope_over_q(q), strength = total(pairs, p);
            const Real viscous = mu * (quadratic_ * mu - linear_) / average;
            const Real below = 1 / (r * r + softening_);
            const Real by_mu = mu >= 0 ? Real(0) : by_total[p] * (2 * quadratic_ * mu - linear_) / average;
            by->distance[p] += -along * unit_ * strength * kernel_.bend(q) / support_ - by_mu * mu * 2 * r * below;
            for (int c = 0; c < 3; ++c) {
                by->x[c][p] += slope * strength * given[c][p] + by_mu * half_support() * below * pairs.v[c][p];
                by->v[c][p] += by_mu * half_support() * below * pairs.x[c][p];
            }
            for (int side = 0; side < 2; ++side) {
                by->scalar[side][push_][p] += by_total[p];
                by->scalar[side][density_][p] -= by_total[p] * viscous / (2 * average);
            }
        }
    }

   private:
    SmoothingKernel<Real> kernel_;
    int push_, density_;
    Real support_, unit_, softening_, linear_, quadratic_;

    Real half_support() const { return support_ / 2; }

    Real mean(const Block<Real>& pairs, int p) const {
        return (pairs.scalar[0][density_][p] + pairs.scalar[1][density_][p]) / 2;
    }

    Real rate(const Block<Real>& pairs, int p) const {
        const Real r = pairs.distance[p];
        const Real approach = dot(pairs.x, pairs.v, p);
        const Real mu = half_support() * approach / (r * r + softening_);
        return mu > 0 ? Real(0) : mu;
    }

    Real total(const Block<Real>& pairs, int p) const {
        const Real mu = rate(pairs, p);
        return pairs.scalar[0][push_][p] + pairs.scalar[1][push_][p] +
               mu * (quadratic_ * mu - linear_) / mean(pairs, p);
    }
};

// What makes the rate of density of smoothed particle hydrodynamics: v.x W'/r, and, with two components, (rho_j - rho_i)
// W'/r, both over rho_i rho_j. Constants: the distance at which W ends, in filter widths, and the units of both. The
// scalar: rho.
template <typename Real>
class Continuity : public Summand<Real> {
   public:
    Continuity(bool wendland, int components, int density, const double* constants)
        : Summand<Real>(components, Real(1)), kernel_{wendland}, density_(density), support_(constants[0]),
          units_{static_cast<Real>(constants[1]), static_cast<Real>(constants[2])} {
        this->parity[1] = -1;
    }

    void values(const Block<Real>& pairs, Components<Real> found) override {
        const Real *own = pairs.scalar[0][density_], *other = pairs.scalar[1][density_];
        EDDIES_PAIRS found[0][p] = units_[0] * slope(pairs, p) * dot(pairs.x, pairs.v, p);
        if (this->components == 2)
            EDDIES_PAIRS found[1][p] = units_[1] * slope(pairs, p) * (other[p] - own[p]);
    }

    void gradients(const Block<Real>& pairs, GivenComponents<Real> given, ByPairs<Real>* by, Real*) override {
        if (!by) return;
        const Real *own = pairs.scalar[0][density_], *other = pairs.scalar[1][density_];
        const bool diffusive = this->components == 2;
        EDDIES_PAIRS {
            const Real q = pairs.distance[p] / support_, below = 1 / (own[p] * other[p]);
            const Real first = units_[0] * given[0][p], second = diffusive ? units_[1] * given[1][p] : Real(0);
            const Real by_slope = first * dot(pairs.x, pairs.v, p) + second * (other[p] - own[p]);
            const Real steep = slope(pairs, p), along = first * steep, across = second * steep;
            by->distance[p] += by_slope * below * kernel_.bend(q) / support_;
            for (int c = 0; c < 3; ++c) {
                by->x[c][p] += along * pairs.v[c][p];
                by->v[c][p] += along * pairs.x[c][p];
            }
            by->scalar[0][density_][p] -= across + by_slope * steep / own[p];
            by->scalar[1][density_][p] += across - by_slope * steep / other[p];
        }
    }

   private:
    SmoothingKernel<Real> kernel_;
    int density_;
    Real support_, units_[2];

    // W'/r over both densities.
    Real slope(const Block<Real>& pairs, int p) const {
        return kernel_.slope_over_q(pairs.distance[p] / support_) /
               (pairs.scalar[0][density_][p] * pairs.scalar[1][density_][p]);
    }
};

// -(1/rho_i^2 + 1/rho_j^2) W'/r x, and the entries of -v x^T W'/r over rho_i rho_j. Constants: the distance at which W
// ends, in filter widths, and the units of both. The scalar: rho.
template <typename Real>
class TransportVelocity : public Summand<Real> {
   public:
    TransportVelocity(bool wendland, int density, const double* constants)
        : Summand<Real>(12, Real(1)), kernel_{wendland}, density_(density), support_(constants[0]),
          push_(constants[1]), carry_(constants[2]) {
        for (int c = 0; c < 3; ++c) this->parity[c] = -1;
    }

    void values(const Block<Real>& pairs, Components<Real> found) override {
        const Real *own = pairs.scalar[0][density_], *other = pairs.scalar[1][density_];
        EDDIES_PAIRS {
            const Real slope = -kernel_.slope_over_q(pairs.distance[p] / support_);
            const Real first = 1 / own[p], second = 1 / other[p];
            const Real push = push_ * slope * (first * first + second * second), carry = carry_ * slope * first * second;
            for (int c = 0; c < 3; ++c) {
                found[c][p] = push * pairs.x[c][p];
                for (int a = 0; a < 3; ++a) found[3 + 3 * a + c][p] = carry * pairs.v[a][p] * pairs.x[c][p];
            }
        }
    }

    void gradients(const Block<Real>& pairs, GivenComponents<Real> given, ByPairs<Real>* by, Real*) override {
        if (!by) return;
        const Real *own = pairs.scalar[0][density_], *other = pairs.scalar[1][density_];
        EDDIES_PAIRS {
            const Real q = pairs.distance[p] / support_, slope = -kernel_.slope_over_q(q);
            const Real first = 1 / own[p], second = 1 / other[p];
            const Real push = push_ * (first * first + second * second), carry = carry_ * first * second;
            Real along = 0, across = 0;  // the gradients of the two by the slope, over push and carry
            for (int c = 0; c < 3; ++c) {
                along += given[c][p] * pairs.x[c][p];
                Real by_x = push * given[c][p];
                for (int a = 0; a < 3; ++a) {
                    const Real one = given[3 + 3 * a + c][p];
                    across += one * pairs.v[a][p] * pairs.x[c][p];
                    by_x += carry * one * pairs.v[a][p];
                    by->v[a][p] += slope * carry * one * pairs.x[c][p];
                }
                by->x[c][p] += slope * by_x;
            }
            by->distance[p] -= (push * along + carry * across) * kernel_.bend(q) / support_;
            by->scalar[0][density_][p] -= slope * first * (2 * push_ * along * first * first + carry * across);
            by->scalar[1][density_][p] -= slope * second * (2 * push_ * along * second * second + carry * across);
        }
    }

   private:
    SmoothingKernel<Real> kernel_;
    int density_;
    Real support_, push_, carry_;
};

// W of the distance, in units of length.
template <typename Real>
class KernelSum : public Summand<Real> {
   public:
    explicit KernelSum(const double* constants) : Summand<Real>(1, Real(1)), kernel_(constants) {}

    void values(const Block<Real>& pairs, Components<Real> found) override {
        for (int p = 0; p < BLOCK; p += VectorOf<Real>::lanes)
            vector_at(found[0] + p) = kernel_.value(vector_at(pairs.distance + p));
    }

    void gradients(const Block<Real>&, GivenComponents<Real>, ByPairs<Real>*, Real*) override {}

   private:
    Smoothing<Real> kernel_;
};

// What makes the average of a vector a and its gradient, relative to the first particle's own: V W, V W a', V grad W
// and V a'_c grad_d W with a' = a_j - a_i. Scalars: V, and the components of a.
template <typename Real>
class KernelAverage : public Summand<Real> {
   public:
    KernelAverage(int scalar, const double* constants)
        : Summand<Real>(16, Real(1)), scalar_(scalar), kernel_(constants) {}

    void values(const Block<Real>& pairs, Components<Real> found) override {
        const Real* volume = pairs.scalar[1][scalar_];
        alignas(64) Real slope[BLOCK];
        for (int p = 0; p < BLOCK; p += VectorOf<Real>::lanes) {
            const Vector<Real> r = vector_at(pairs.distance + p);
            Vector<Real> rate;
            vector_at(found[0] + p) = vector_at(volume + p) * kernel_.value(r, rate);
            vector_at(slope + p) = r > 0 ? vector_at(volume + p) * rate / r : Vector<Real>{};
        }
        for (int d = 0; d < 3; ++d)
            EDDIES_PAIRS found[4 + d][p] = slope[p] * pairs.x[d][p];
        for (int c = 0; c < 3; ++c) {
            const Real *own = pairs.scalar[0][scalar_ + 1 + c], *other = pairs.scalar[1][scalar_ + 1 + c];
            EDDIES_PAIRS {
                const Real apart = other[p] - own[p];
                found[1 + c][p] = found[0][p] * apart;
                for (int d = 0; d < 3; ++d) found[7 + 3 * c + d][p] = found[4 + d][p] * apart;
            }
        }
    }

    void gradients(const Block<Real>&, GivenComponents<Real>, ByPairs<Real>*, Real*) override {}

   private:
    int scalar_;
    Smoothing<Real> kernel_;
};

#undef EDDIES_PAIRS

}  // namespace eddies
