// Summands over pairs of particles. The terms in eddies/particles/terms define them. Each is registered by name where
// it is implemented: as a formula, whose gradient adjoint.hpp derives, or as a class of its own.

#pragma once

#include <cmath>
#include <limits>
#include <map>
#include <memory>
#include <string>

#include "adjoint.hpp"
#include "network.hpp"
#include "smoothing.hpp"

extern "C" {

// A summand, and arrays for its sums and gradients, which are null if not requested. kernels/pairs.py has the same
// structure.
struct Given {
    const char* kind;
    std::int64_t numbers_count, parameters_count, components, scalar;  // `scalar`: the first one that it reads
    const double *numbers, *parameters;
    const double* parity;      // (components): factor of the value for the second particle of a mutual pair
    void* sums;                // (components, count)
    const void* by_sums;       // (components, count)
    double* by_parameters;     // (parameters)
};

}  // extern "C"

namespace eddies {

constexpr int MOST_SCALARS = 4;  // columns of numbers that particles carry

// A block of pairs: their separations x in filter widths and velocity differences v in units of the velocity, both of
// the first minus the second particle; the length of x; the weight (1 - q^2)^2, where q is this length divided by the
// radius; and the scalars of the first and the second particles.
template <typename Real>
struct Block {
    alignas(64) Real x[3][BLOCK], v[3][BLOCK], distance[BLOCK], weight[BLOCK];
    const Real* scalar[2][MOST_SCALARS];
};

// Gradients with respect to the members of Block, zero at first. Those with respect to separation, velocity difference
// and scalars are rows in the order of the records of first and second particles.
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

template <typename Real>
class Summand {
   public:
    const int components;
    int scalars = 0, parameters = 0;  // how many of each it reads
    bool differentiable = true;

    explicit Summand(int components) : components(components) {}
    virtual ~Summand() = default;

    // Compute the components of pairs.
    virtual void values(const Block<Real>& pairs, Components<Real> result) = 0;

    // From the gradients with respect to the components, add to those with respect to the quantities of the pairs,
    // unless these are null, and to those with respect to the parameters, a vector for each parameter.
    virtual void gradients(const Block<Real>&, GivenComponents<Real>, ByPairs<Real>*, Real*) {}
};

// Kinds of summands by name, local to this library: libraries for other instruction sets may be loaded too.
struct Kind {
    std::unique_ptr<Summand<float>> (*single)(const Given&);
    std::unique_ptr<Summand<double>> (*full)(const Given&);
};

static std::map<std::string, Kind>& kinds() {
    static std::map<std::string, Kind> all;
    return all;
}

template <typename Made, typename Real>
std::unique_ptr<Summand<Real>> make(const Given& given) {
    return std::make_unique<Made>(given);
}

template <template <typename> class Class>
bool declare(const char* name) {
    return kinds().insert({name, {make<Class<float>, float>, make<Class<double>, double>}}).second;
}

// Arguments of a formula for a vector of pairs: each a `Vector`, a `Place` or a `Constant`.
template <typename Real, template <typename> class Column, template <typename> class Parameter, int scalars,
          int parameters>
struct Pairs {
    Column<Real> x[3], v[3], distance, weight, own[scalars + 1], other[scalars + 1];
    Parameter<Real> parameter[parameters + 1];

    void read(const Block<Real>& pairs, int scalar, int p) {
        for (int axis = 0; axis < 3; ++axis) {
            x[axis] = vector_at(pairs.x[axis] + p);
            v[axis] = vector_at(pairs.v[axis] + p);
        }
        distance = vector_at(pairs.distance + p);
        weight = vector_at(pairs.weight + p);
        for (int s = 0; s < scalars; ++s) {
            own[s] = vector_at(pairs.scalar[0][scalar + s] + p);
            other[s] = vector_at(pairs.scalar[1][scalar + s] + p);
        }
    }

    void add_to(ByPairs<Real>& by, int scalar, int p) const {
        for (int axis = 0; axis < 3; ++axis) {
            vector_at(by.x[axis] + p) += x[axis].by;
            vector_at(by.v[axis] + p) += v[axis].by;
        }
        vector_at(by.distance + p) += distance.by;
        vector_at(by.weight + p) += weight.by;
        for (int s = 0; s < scalars; ++s) {
            vector_at(by.scalar[0][scalar + s] + p) += own[s].by;
            vector_at(by.scalar[1][scalar + s] + p) += other[s].by;
        }
    }
};

// The summand of a formula. The formula is constructed from `Given`. It is called with `Pairs` and a function that
// takes the number of a component and its value.
template <typename Real, template <typename> class Formula>
class FormulaSummand : public Summand<Real> {
    using V = Vector<Real>;
    static constexpr int lanes = VectorOf<Real>::lanes, columns = Formula<Real>::scalars,
                         factors = Formula<Real>::parameters;

   public:
    explicit FormulaSummand(const Given& given)
        : Summand<Real>(Formula<Real>(given).components), formula_(given), scalar_(static_cast<int>(given.scalar)) {
        this->scalars = columns;
        this->parameters = factors;
        std::copy_n(given.parameters, std::min<std::int64_t>(factors, given.parameters_count), parameters_);
    }

    void values(const Block<Real>& pairs, Components<Real> result) override {
        Pairs<Real, Vector, Vector, columns, factors> some;
        for (int k = 0; k < factors; ++k) some.parameter[k] = V{} + parameters_[k];
        for (int p = 0; p < BLOCK; p += lanes) {
            some.read(pairs, scalar_, p);
            formula_(some, [&](int c, const V& value) { vector_at(result[c] + p) = value; });
        }
    }

    void gradients(const Block<Real>& pairs, GivenComponents<Real> given, ByPairs<Real>* by,
                   Real* by_parameters) override {
        if (by) back<Place>(pairs, given, by, by_parameters);
        else if (factors) back<Constant>(pairs, given, by, by_parameters);
    }

   private:
    Formula<Real> formula_;
    int scalar_;
    Real parameters_[factors + 1];

    template <template <typename> class Column>
    void back(const Block<Real>& pairs, GivenComponents<Real> given, ByPairs<Real>* by, Real* by_parameters) {
        V sums[factors + 1]{};
        for (int p = 0; p < BLOCK; p += lanes) {
            Pairs<Real, Column, Place, columns, factors> some;
            some.read(pairs, scalar_, p);
            for (int k = 0; k < factors; ++k) some.parameter[k] = V{} + parameters_[k];
            formula_(some, [&](int c, const auto& value) { value.back(vector_at(given[c] + p)); });
            for (int k = 0; k < factors; ++k) sums[k] += some.parameter[k].by;
            if constexpr (std::is_same_v<Column<Real>, Place<Real>>) some.add_to(*by, scalar_, p);
        }
        for (int k = 0; k < factors; ++k) vector_at(by_parameters + k * lanes) += sums[k];
    }
};

template <typename Real, template <typename> class Formula>
std::unique_ptr<Summand<Real>> make_formula(const Given& given) {
    return std::make_unique<FormulaSummand<Real, Formula>>(given);
}

template <template <typename> class Formula>
bool declare_formula(const char* name) {
    return kinds().insert({name, {make_formula<float, Formula>, make_formula<double, Formula>}}).second;
}

// A loop over lanes, which the compiler vectorises.
#define EDDIES_PAIRS _Pragma("omp simd") for (int p = 0; p < BLOCK; ++p)

// Scalar product of two vectors of a pair.
template <typename Real>
inline Real dot(const Real (*a)[BLOCK], const Real (*b)[BLOCK], int p) {
    return a[0][p] * b[0][p] + a[1][p] * b[1][p] + a[2][p] * b[2][p];
}

// Added to lengths by which vectors are divided (particles/terms/pair_network.py).
constexpr double SMALL = 1e-6;

// w NN_1 x and w NN_2 v or, with one output, w NN, where NN is a network of the pairs' invariants. Options: unit
// vectors x/|x| and v/|v| take the place of x and v; w is 1, because pairs are not weighted; a single output is
// multiplied by the sign of the difference of densities.
template <typename Real>
class PairNetwork : public Summand<Real> {
   public:
    // Numbers: the number of outputs; whether densities enter as their sum and the square of their difference; whether
    // the network reads density (the scalar), distance, speed, approach; whether directions are unit vectors; whether
    // pairs are weighted; whether the output is multiplied by the sign; and the widths of the hidden layers.
    explicit PairNetwork(const Given& given)
        : Summand<Real>(given.numbers[0] == 2 ? 6 : 1), symmetric_(given.numbers[1]),
          scalar_(static_cast<int>(given.scalar)), density_(given.numbers[2]), distance_(given.numbers[3]),
          speed_(given.numbers[4]), approach_(given.numbers[5]), unit_(given.numbers[6]), weighted_(given.numbers[7]),
          sign_(given.numbers[8]), network_(widths(given), given.parameters, given.parameters_count) {
        this->scalars = density_ || sign_;
        this->parameters = static_cast<int>(given.parameters_count);
        std::fill_n(by_x_, BLOCK, Real(1));
        std::fill_n(by_v_, BLOCK, Real(1));
    }

    void values(const Block<Real>& pairs, Components<Real> result) override {
        evaluate(pairs);
        const Rows<Real>& outputs = network_.outputs();
        const Real* along_x = outputs[0];
        if (this->components == 1) {
            EDDIES_PAIRS result[0][p] = window_[p] * by_x_[p] * along_x[p];
            return;
        }
        const Real* along_v = outputs[1];
        for (int c = 0; c < 3; ++c) {
            EDDIES_PAIRS result[c][p] = window_[p] * by_x_[p] * along_x[p] * pairs.x[c][p];
            EDDIES_PAIRS result[3 + c][p] = window_[p] * by_v_[p] * along_v[p] * pairs.v[c][p];
        }
    }

    void gradients(const Block<Real>& pairs, GivenComponents<Real> given, ByPairs<Real>* by_pairs,
                   Real* by_parameters) override {
        evaluate(pairs);
        Rows<Real>& by_outputs = network_.by_outputs();
        if (this->components == 1) {
            EDDIES_PAIRS by_outputs[0][p] = window_[p] * by_x_[p] * given[0][p];
        } else {
            Real *by_x = by_outputs[0], *by_v = by_outputs[1];
            EDDIES_PAIRS by_x[p] = window_[p] * by_x_[p] * dot(given, pairs.x, p);
            EDDIES_PAIRS by_v[p] = window_[p] * by_v_[p] * dot(given + 3, pairs.v, p);
        }
        network_.backward(by_parameters, by_pairs != nullptr);
        if (by_pairs) add_by_pairs(pairs, given, *by_pairs);
    }

   private:
    bool symmetric_;
    int scalar_;
    bool density_, distance_, speed_, approach_, unit_, weighted_, sign_;
    Network<Real> network_;
    // |v|; the factors of x and v, which are 1, or 1/|x| and 1/|v|, or the sign for x; w if pairs are not weighted.
    alignas(64) Real speed_of_[BLOCK], by_x_[BLOCK], by_v_[BLOCK], open_[BLOCK];
    const Real* window_;  // w

    static std::vector<int> widths(const Given& given) {
        const double* numbers = given.numbers;
        std::vector<int> widths(1, static_cast<int>(2 * numbers[2] + numbers[3] + numbers[4] + numbers[5]));
        widths.insert(widths.end(), numbers + 9, numbers + given.numbers_count);
        widths.push_back(static_cast<int>(numbers[0]));
        return widths;
    }

    // Inlining in both callers is slower by up to a twentieth.
    __attribute__((noinline)) void evaluate(const Block<Real>& pairs) {
        Rows<Real>& features = network_.features();
        int row = 0;
        if (speed_ || unit_) EDDIES_PAIRS speed_of_[p] = std::sqrt(dot(pairs.v, pairs.v, p));
        if (density_) {
            const Real *own = pairs.scalar[0][scalar_], *other = pairs.scalar[1][scalar_];
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
        if (speed_) std::copy(speed_of_, speed_of_ + BLOCK, features[row++]);
        if (approach_) {
            Real* feature = features[row];
            EDDIES_PAIRS feature[p] = dot(pairs.x, pairs.v, p);
        }
        find_factors(pairs);
        network_.forward();
    }

    void find_factors(const Block<Real>& pairs) {
        const Real* w = pairs.weight;
        window_ = weighted_ ? w : open_;
        if (!weighted_) EDDIES_PAIRS open_[p] = Real(w[p] > 0);
        if (unit_) EDDIES_PAIRS {
                by_x_[p] = 1 / (pairs.distance[p] + Real(SMALL));
                by_v_[p] = 1 / (speed_of_[p] + Real(SMALL));
            }
        if (sign_) {
            const Real *own = pairs.scalar[0][scalar_], *other = pairs.scalar[1][scalar_];
            EDDIES_PAIRS by_x_[p] = Real(own[p] > other[p]) - Real(own[p] < other[p]);
        }
    }

    void add_by_pairs(const Block<Real>& pairs, GivenComponents<Real> given, ByPairs<Real>& by) {
        const Rows<Real>&by_features = network_.by_features(), &outputs = network_.outputs();
        const Real* along_x = outputs[0];
        if (this->components == 1) {
            if (weighted_) EDDIES_PAIRS by.weight[p] += given[0][p] * along_x[p] * by_x_[p];
        } else {
            add_by_directions(pairs, given, along_x, outputs[1], by);
        }
        int row = 0;
        if (density_) {
            const Real *own = pairs.scalar[0][scalar_], *other = pairs.scalar[1][scalar_];
            const Real *first = by_features[row++], *second = by_features[row++];
            Real *by_own = by.scalar[0][scalar_], *by_other = by.scalar[1][scalar_];
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

    // Add the gradient of w NN_1 b_1 and w NN_2 b_2 with respect to w and to the directions b, at fixed NN_1 and NN_2.
    void add_by_directions(const Block<Real>& pairs, GivenComponents<Real> given, const Real* along_x,
                           const Real* along_v, ByPairs<Real>& by) {
        for (int c = 0; c < 3; ++c) EDDIES_PAIRS {
                by.x[c][p] += given[c][p] * window_[p] * by_x_[p] * along_x[p];
                by.v[c][p] += given[3 + c][p] * window_[p] * by_v_[p] * along_v[p];
            }
        if (!weighted_ && !unit_) return;
        alignas(64) Real by_speed[BLOCK];
        EDDIES_PAIRS {
            const Real of_x = along_x[p] * by_x_[p] * dot(given, pairs.x, p);
            const Real of_v = along_v[p] * by_v_[p] * dot(given + 3, pairs.v, p);
            by.weight[p] += weighted_ ? of_x + of_v : Real(0);
            by.distance[p] -= unit_ ? window_[p] * of_x * by_x_[p] : Real(0);
            by_speed[p] = unit_ && speed_of_[p] > 0 ? window_[p] * of_v * by_v_[p] / speed_of_[p] : Real(0);
        }
        if (unit_)
            for (int c = 0; c < 3; ++c) EDDIES_PAIRS by.v[c][p] -= by_speed[p] * pairs.v[c][p];
    }
};

static const bool pair_network = declare<PairNetwork>("pair-network");

// w, and the entries xx, xy, xz, yy, yz, zz of w x x^T.
template <typename Real>
struct Moments {
    static constexpr int components = 7, scalars = 0, parameters = 0;

    explicit Moments(const Given&) {}

    template <typename Pairs, typename Give>
    void operator()(const Pairs& pairs, const Give& give) const {
        const auto &x = pairs.x, &w = pairs.weight;
        int c = 0;
        give(c++, w);
        for (int i = 0; i < 3; ++i) {
            const auto weighted = let(w * x[i]);
            for (int j = i; j < 3; ++j) give(c++, weighted * x[j]);
        }
    }
};

static const bool moments = declare_formula<Moments>("moments");

// w or, if pairs are not weighted, 1 for pairs within the radius.
template <typename W>
inline auto window(const W& w, bool weighted) {
    using Real = std::decay_t<decltype(value_of(w)[0])>;
    const Real kept = weighted ? 1 : 0;
    const auto within = value_of(w) > Real(0);
    return kept * w + where(within, Vector<Real>{} + (Real(1) - kept), Vector<Real>{});
}

// tanh of a number if `bounded`, else the number itself.
template <typename A>
inline auto tanh_if(bool bounded, const A& a) {
    using V = std::decay_t<decltype(value_of(a))>;
    using Real = std::decay_t<decltype(value_of(a)[0])>;
    V value = value_of(a);
    if (bounded) {
        V numbers[TOGETHER] = {value * Real(TANH_UNIT<Real>)};
        tanh_of(reinterpret_cast<Real*>(numbers));
        value = numbers[0];
    }
    if constexpr (is_node<A>)
        return made(a, Constant<Real>(), value, bounded ? Real(1) - value * value : V{} + Real(1), V{});
    else
        return value;
}

// w Pi x/(unit |x| + length) with Pi = mu (|a_2| mu - |a_1|), mu = x.v / (|x|^2 + softening). Form 0 is for all pairs;
// in form 1 mu is 0 unless the particles approach; form 2 has tanh(x.v) in place of x.v. Numbers: the form, the
// softening, whether pairs are weighted, unit and length. Parameters: |a_1| and |a_2|.
template <typename Real>
struct EddyViscosity {
    static constexpr int components = 3, scalars = 0, parameters = 2;
    bool bounded;
    Real limit, softening;
    bool weighted;
    Real unit, length;

    explicit EddyViscosity(const Given& given)
        : bounded(given.numbers[0] == 2),
          limit(given.numbers[0] == 1 ? Real(0) : std::numeric_limits<Real>::infinity()), softening(given.numbers[1]),
          weighted(given.numbers[2]), unit(given.numbers[3]), length(given.numbers[4]) {}

    template <typename Pairs, typename Give>
    void operator()(const Pairs& pairs, const Give& give) const {
        const auto &x = pairs.x, &r = pairs.distance, &linear = pairs.parameter[0], &quadratic = pairs.parameter[1];
        const auto approach = let(product(x, pairs.v));
        const auto rate = let(tanh_if(bounded, approach) / (r * r + softening));
        const auto mu = let(at_most(rate, limit));
        const auto w = let(window(pairs.weight, weighted));
        const auto strength = let(w * mu * (quadratic * mu - linear) / (unit * r + length));
        for (int c = 0; c < 3; ++c) give(c, strength * x[c]);
    }
};

static const bool eddy_viscosity = declare_formula<EddyViscosity>("eddy-viscosity");

// -w (|b_1| + |b_2| |q|) q, q = (rho'_i - rho'_j) / (|x|^2 + softening). Numbers: the softening, and whether pairs are
// weighted. Parameters: |b_1| and |b_2|. The scalar: rho'.
template <typename Real>
struct DensityDiffusion {
    static constexpr int components = 1, scalars = 1, parameters = 2;
    Real softening;
    bool weighted;

    explicit DensityDiffusion(const Given& given) : softening(given.numbers[0]), weighted(given.numbers[1]) {}

    template <typename Pairs, typename Give>
    void operator()(const Pairs& pairs, const Give& give) const {
        const auto &r = pairs.distance, &linear = pairs.parameter[0], &quadratic = pairs.parameter[1];
        const auto w = let(window(pairs.weight, weighted));
        const auto q = let((pairs.own[0] - pairs.other[0]) / (r * r + softening));
        const auto size = where(value_of(q) < Real(0), Real(-1) * q, q);
        give(0, Real(-1) * w * (linear + quadratic * size) * q);
    }
};

static const bool density_diffusion = declare_formula<DensityDiffusion>("density-diffusion");

// -W'/q h^4 of the cubic spline W as a function of q = r/h <= 1.
template <typename Q>
inline auto spline_fall(const Q& q) {
    using Real = std::decay_t<decltype(value_of(q)[0])>;
    const auto inner = value_of(q) < Real(0.5);
    return Real(48 / M_PI) *
           where(inner, Real(2) - Real(3) * q, (Real(1) - q) * (Real(1) - q) / where(inner, Real(1), q));
}

// Force of weakly compressible smoothed particle hydrodynamics, (P_i/rho_i^2 + P_j/rho_j^2 + Pi) (-W'/r) x, in filter
// widths and units of the velocity. Numbers: the distance at which W ends, the unit of the result, and the softening.
// Parameters: alpha c and beta of Pi. Scalars: P/rho^2 and rho.
template <typename Real>
struct Wcsph {
    static constexpr int components = 3, scalars = 2, parameters = 2;
    Real support, unit, softening;

    explicit Wcsph(const Given& given)
        : support(given.numbers[0]), unit(given.numbers[1]), softening(given.numbers[2]) {}

    template <typename Pairs, typename Give>
    void operator()(const Pairs& pairs, const Give& give) const {
        const auto &x = pairs.x, &r = pairs.distance, &linear = pairs.parameter[0], &quadratic = pairs.parameter[1];
        const auto q = let(r * (1 / support));
        const auto rate = let(support / 2 * product(x, pairs.v) / (r * r + softening));
        const auto mu = let(at_most(rate, Real(0)));
        const auto viscous = Real(2) * mu * (quadratic * mu - linear) / (pairs.own[1] + pairs.other[1]);
        const auto strength = let(unit * (pairs.own[0] + pairs.other[0] + viscous) * spline_fall(q));
        for (int c = 0; c < 3; ++c) give(c, strength * x[c]);
    }
};

static const bool wcsph = declare_formula<Wcsph>("wcsph");

// Density rate of smoothed particle hydrodynamics: v.x W'/r and, with two components, (rho_j - rho_i) W'/r, both over
// rho_i rho_j. Numbers: the distance at which W ends, in filter widths, and the units of both. The scalar: rho.
template <typename Real>
struct Continuity {
    static constexpr int scalars = 1, parameters = 0;
    int components;
    Real support, units[2];

    explicit Continuity(const Given& given)
        : components(given.components == 2 ? 2 : 1), support(given.numbers[0]),
          units{static_cast<Real>(given.numbers[1]), static_cast<Real>(given.numbers[2])} {}

    template <typename Pairs, typename Give>
    void operator()(const Pairs& pairs, const Give& give) const {
        const auto &own = pairs.own[0], &other = pairs.other[0];
        const auto q = let(pairs.distance * (1 / support));
        const auto fall = let(spline_fall(q) / (own * other));
        give(0, -units[0] * fall * product(pairs.x, pairs.v));
        if (components == 2) give(1, units[1] * fall * (own - other));
    }
};

static const bool continuity = declare_formula<Continuity>("continuity");

// -(1/rho_i^2 + 1/rho_j^2) W'/r x, and the entries of -v x^T W'/r over rho_i rho_j. Numbers: the distance at which W
// ends, in filter widths, and the units of both. The scalar: rho.
template <typename Real>
struct TransportVelocity {
    static constexpr int components = 12, scalars = 1, parameters = 0;
    Real support, push_unit, carry_unit;

    explicit TransportVelocity(const Given& given)
        : support(given.numbers[0]), push_unit(given.numbers[1]), carry_unit(given.numbers[2]) {}

    template <typename Pairs, typename Give>
    void operator()(const Pairs& pairs, const Give& give) const {
        const auto &x = pairs.x, &v = pairs.v;
        const auto q = let(pairs.distance * (1 / support));
        const auto fall = let(spline_fall(q));
        const auto first = let(Real(1) / pairs.own[0]), second = let(Real(1) / pairs.other[0]);
        const auto push = let(push_unit * fall * (first * first + second * second));
        const auto carry = let(carry_unit * fall * first * second);
        for (int c = 0; c < 3; ++c) {
            give(c, push * x[c]);
            const auto along = let(carry * x[c]);
            for (int a = 0; a < 3; ++a) give(3 + 3 * a + c, along * v[a]);
        }
    }
};

static const bool transport_velocity = declare_formula<TransportVelocity>("transport-velocity");

// W at the distance, in units of length.
template <typename Real>
class KernelSum : public Summand<Real> {
   public:
    explicit KernelSum(const Given& given) : Summand<Real>(1), kernel_(given.numbers) {
        this->differentiable = false;
    }

    void values(const Block<Real>& pairs, Components<Real> result) override {
        for (int p = 0; p < BLOCK; p += VectorOf<Real>::lanes)
            vector_at(result[0] + p) = kernel_.value(vector_at(pairs.distance + p));
    }

   private:
    Smoothing<Real> kernel_;
};

static const bool kernel_sum = declare<KernelSum>("kernel-sum");

// Sums for the average of a vector a and its gradient, relative to the first particle's own a: V W, V W a', V grad W
// and V a'_c grad_d W with a' = a_j - a_i. Scalars: V, and the components of a.
template <typename Real>
class KernelAverage : public Summand<Real> {
   public:
    explicit KernelAverage(const Given& given)
        : Summand<Real>(16), scalar_(static_cast<int>(given.scalar)), kernel_(given.numbers) {
        this->scalars = 4;
        this->differentiable = false;
    }

    void values(const Block<Real>& pairs, Components<Real> result) override {
        const Real* volume = pairs.scalar[1][scalar_];
        alignas(64) Real slope[BLOCK];
        for (int p = 0; p < BLOCK; p += VectorOf<Real>::lanes) {
            const Vector<Real> r = vector_at(pairs.distance + p);
            Vector<Real> rate;
            vector_at(result[0] + p) = vector_at(volume + p) * kernel_.value(r, rate);
            vector_at(slope + p) = r > 0 ? vector_at(volume + p) * rate / r : Vector<Real>{};
        }
        for (int d = 0; d < 3; ++d)
            EDDIES_PAIRS result[4 + d][p] = slope[p] * pairs.x[d][p];
        for (int c = 0; c < 3; ++c) {
            const Real *own = pairs.scalar[0][scalar_ + 1 + c], *other = pairs.scalar[1][scalar_ + 1 + c];
            EDDIES_PAIRS {
                const Real apart = other[p] - own[p];
                result[1 + c][p] = result[0][p] * apart;
                for (int d = 0; d < 3; ++d) result[7 + 3 * c + d][p] = result[4 + d][p] * apart;
            }
        }
    }

   private:
    int scalar_;
    Smoothing<Real> kernel_;
};

static const bool kernel_average = declare<KernelAverage>("kernel-average");

#undef EDDIES_PAIRS

}  // namespace eddies
