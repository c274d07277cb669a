// Kriging: by which weights of what neighbours have a random field with a given covariance and an unknown mean, and its
// derivatives, are told best at a point. Receivers are taken together, one in each lane of a vector.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "vectors.hpp"

extern "C" {

// Receivers and their neighbours in compressed rows; kernels/kriging.py has the same structure.
struct Kriging {
    std::int64_t receivers, pairs;
    const std::int64_t* offsets;    // (receivers + 1,)
    const void* displacement;       // (3, pairs), from a neighbour to its receiver
    double support, noise;          // the latter is that of a neighbour at the receiver's own place
    std::int64_t most;              // neighbours of a receiver; one with more has weights that are no numbers
    std::int64_t scales;
    double slowest;                 // the covariance is sum_m amplitude_m exp(-slowest 2^m r^2), the widest first
    const double* amplitudes;       // (scales,)
    void* own;                      // (10, receivers)
    void* const* weights;           // ten of (pairs,)
};

}  // extern "C"

namespace {

using eddies::Vector;
using Int = std::int64_t;

constexpr int FUNCTIONALS = 10, SIDES = FUNCTIONALS + 1, MOST_SCALES = 8;
// Rows and columns of the six second derivatives.
constexpr int FIRST[6] = {0, 0, 0, 1, 1, 2}, SECOND[6] = {0, 1, 2, 1, 2, 2};

template <typename Real>
inline Vector<Real> all(Real number) {
    return Vector<Real>{} + number;
}

// exp(-x) of 0 <= x: 2^-n times a polynomial, to some last places of single or double precision; 0 from where that has
// no normal numbers.
template <typename Real>
inline Vector<Real> exp_minus(Vector<Real> x) {
    constexpr bool single = sizeof(Real) == 4;
    constexpr Real most = single ? 87 : 708, shift = single ? Real(12582912) : Real(6755399441055744);
    const auto beyond = x > all<Real>(most);
    x = beyond ? all<Real>(most) : x;
    const Vector<Real> n = (x * Real(-1.4426950408889634) + shift) - shift;  // rounded
    // What remains, of at most ln 2 / 2; ln 2 in two parts, of which the first has few digits.
    constexpr Real high = single ? Real(0.693359375) : Real(0.693147180369123816490);
    constexpr Real low = single ? Real(-2.12194440e-4) : Real(1.90821492927058770002e-10);
    const Vector<Real> y = (-x - n * high) - n * low;
    constexpr int terms = single ? 7 : 13;
    Vector<Real> sum = all<Real>(1);
    for (int k = terms; k > 0; --k) sum = 1 + sum * y * (Real(1) / Real(k));
    using Bits = eddies::BitVector<Real>;
    const Bits power = __builtin_convertvector(n, Bits) << (single ? 23 : 52);
    const Vector<Real> found = (Vector<Real>)((Bits)sum + power);
    return beyond ? Vector<Real>{} : found;
}

// The covariance as a function of r^2, and its first and second derivative by r^2.
template <typename Real>
struct Covariance {
    Real slowest, amplitudes[MOST_SCALES];
    int scales;

    explicit Covariance(const Kriging& k) : slowest(static_cast<Real>(k.slowest)), scales(static_cast<int>(k.scales)) {
        for (int m = 0; m < scales; ++m) amplitudes[m] = static_cast<Real>(k.amplitudes[m]);
    }

    Vector<Real> operator()(Vector<Real> square) const {
        Vector<Real> power = exp_minus<Real>(square * slowest), sum{};
        for (int m = 0; m < scales; ++m, power *= power) sum += amplitudes[m] * power;
        return sum;
    }

    void derivatives(Vector<Real> square, Vector<Real>& first, Vector<Real>& second) const {
        Vector<Real> power = exp_minus<Real>(square * slowest);
        first = second = Vector<Real>{};
        Real rate = slowest;
        for (int m = 0; m < scales; ++m, power *= power, rate *= 2) {
            first -= rate * amplitudes[m] * power;
            second += rate * rate * amplitudes[m] * power;
        }
    }
};

// The equations of a vector of receivers: matrix and right-hand sides as rows, of which that of the matrix end on its
// diagonal.
template <typename Real>
class Equations {
   public:
    static constexpr int lanes = eddies::VectorOf<Real>::lanes;

    // An odd number of vectors from row to row: those of one column would else fall into few sets of a cache.
    explicit Equations(Int most)
        : apart_(most | 1), places_(3 * most * lanes), noise_(most * lanes), known_(most * lanes),
          rows_((most + SIDES) * apart_ * lanes), inverse_(most * lanes) {}

    void solve(const Kriging& k, const Covariance<Real>& covariance, const Int* receiver, int count) {
        read(k, receiver, count);
        fill(covariance);
        factorise();
        substitute_back();
        leave_means();
        write(k, receiver, count);
    }

   private:
    using V = Vector<Real>;

    V& place(Int j, int axis) { return eddies::vector_at(places_.data() + (3 * j + axis) * lanes); }
    V& noise(Int j) { return eddies::vector_at(noise_.data() + j * lanes); }
    V& known(Int j) { return eddies::vector_at(known_.data() + j * lanes); }
    V* row(Int i) { return reinterpret_cast<V*>(rows_.data() + i * apart_ * lanes); }
    V& inverse(Int j) { return eddies::vector_at(inverse_.data() + j * lanes); }

    // Places relative to the receiver, its own the first. What a lane has fewer than others is 0 in `known`.
    void read(const Kriging& k, const Int* receiver, int count) {
        const auto* displacement = static_cast<const Real*>(k.displacement);
        const Real reach = static_cast<Real>(1 / (k.support * k.support));
        size_ = 1;
        for (int lane = 0; lane < count; ++lane)
            size_ = std::max(size_, 1 + k.offsets[receiver[lane] + 1] - k.offsets[receiver[lane]]);
        for (Int j = 0; j < size_; ++j) {
            known(j) = noise(j) = V{};
            for (int axis = 0; axis < 3; ++axis) place(j, axis) = V{};
        }
        known(0) = all<Real>(1);
        for (int lane = 0; lane < count; ++lane) {
            const Int begin = k.offsets[receiver[lane]], neighbors = k.offsets[receiver[lane] + 1] - begin;
            for (Int j = 0; j < neighbors; ++j) {
                known_.data()[(j + 1) * lanes + lane] = 1;
                for (int axis = 0; axis < 3; ++axis)
                    places_.data()[(3 * (j + 1) + axis) * lanes + lane] = -displacement[axis * k.pairs + begin + j];
            }
        }
        // Neighbours come and go at the support, where their noise is 1e4 times that beside the receiver.
        for (Int j = 0; j < size_; ++j) {
            const V q = square(j, 0) * reach, left = 1 - q * q;
            const V least = all<Real>(Real(1e-4));
            noise(j) = static_cast<Real>(k.noise) / (left > least ? left : least);
        }
    }

    V square(Int i, Int j) {
        const V x = place(i, 0) - place(j, 0), y = place(i, 1) - place(j, 1), z = place(i, 2) - place(j, 2);
        return x * x + y * y + z * z;
    }

    void fill(const Covariance<Real>& covariance) {
        for (Int i = 0; i < size_; ++i) {
            V* entries = row(i);
            for (Int j = 0; j < i; ++j) entries[j] = covariance(square(i, j)) * known(i) * known(j);
            entries[i] = (covariance(V{}) + noise(i)) * known(i) + (1 - known(i));
            V first, second;
            covariance.derivatives(square(i, 0), first, second);
            row(size_)[i] = all<Real>(i == 0);
            row(size_ + FUNCTIONALS)[i] = known(i);
            // By the receiver's place x of C(|x - x_j|^2): -2 C' (x_j - x), and 4 C'' (x_j - x) (x_j - x) + 2 C' I.
            for (int axis = 0; axis < 3; ++axis) row(size_ + 1 + axis)[i] = -2 * first * place(i, axis) * known(i);
            for (int q = 0; q < 6; ++q) {
                const V twice = 4 * second * place(i, FIRST[q]) * place(i, SECOND[q]);
                row(size_ + 4 + q)[i] = (FIRST[q] == SECOND[q] ? twice + 2 * first : twice) * known(i);
            }
        }
    }

    // The factor L of the matrix L L^T in place, and L^-1 b in place of right-hand sides b: four rows at a time against
    // those above.
    void factorise() {
        const Int all_rows = size_ + SIDES;
        for (Int begin = 0; begin < all_rows; begin += 4) {
            V* some[4];
            const int count = static_cast<int>(std::min<Int>(4, all_rows - begin));
            for (int r = 0; r < 4; ++r) some[r] = row(begin + std::min(r, count - 1));
            const Int above = std::min(begin, size_);
            for (Int j = 0; j < above; ++j) {
                const V* given = row(j);
                V sum[4] = {some[0][j], some[1][j], some[2][j], some[3][j]};
                for (Int k = 0; k < j; ++k)
                    for (int r = 0; r < 4; ++r) sum[r] -= some[r][k] * given[k];
                for (int r = 0; r < count; ++r) some[r][j] = sum[r] * inverse(j);
            }
            for (int r = 0; r < count; ++r)  // what four rows of the matrix have below each other
                for (Int j = above; j < size_ && j <= begin + r; ++j) {
                    V sum = some[r][j];
                    for (Int k = 0; k < j; ++k) sum -= some[r][k] * row(j)[k];
                    if (j == begin + r) inverse(j) = 1 / root(sum);
                    else some[r][j] = sum * inverse(j);
                }
        }
    }

    static V root(V square) {
        for (int lane = 0; lane < lanes; ++lane) square[lane] = std::sqrt(square[lane]);
        return square;
    }

    void substitute_back() {
        V* found[SIDES];
        for (int f = 0; f < SIDES; ++f) found[f] = row(size_ + f);
        for (Int k = size_ - 1; k >= 0; --k) {
            const V* given = row(k);
            V last[SIDES];
            for (int f = 0; f < SIDES; ++f) last[f] = found[f][k] *= inverse(k);
            for (Int j = 0; j < k; ++j)
                for (int f = 0; f < SIDES; ++f) found[f][j] -= given[j] * last[f];
        }
    }

    // The mean is not known: less of K^-1 1 what lets the weights of each add up to nothing.
    void leave_means() {
        const V* ones = row(size_ + FUNCTIONALS);
        V whole{};
        for (Int j = 0; j < size_; ++j) whole += ones[j];
        for (int f = 0; f < FUNCTIONALS; ++f) {
            V* found = row(size_ + f);
            V part{};
            for (Int j = 0; j < size_; ++j) part += found[j];
            part /= whole;
            for (Int j = 0; j < size_; ++j) found[j] -= part * ones[j];
        }
    }

    void write(const Kriging& k, const Int* receiver, int count) {
        auto* own = static_cast<Real*>(k.own);
        for (int f = 0; f < FUNCTIONALS; ++f) {
            const auto* found = reinterpret_cast<const Real*>(row(size_ + f));
            auto* weights = static_cast<Real*>(k.weights[f]);
            for (int lane = 0; lane < count; ++lane) {
                const Int begin = k.offsets[receiver[lane]], neighbors = k.offsets[receiver[lane] + 1] - begin;
                own[f * k.receivers + receiver[lane]] = found[lane];
                for (Int j = 0; j < neighbors; ++j) weights[begin + j] = found[(j + 1) * lanes + lane];
            }
        }
    }

    Int apart_, size_ = 0;
    eddies::Aligned<Real> places_, noise_, known_, rows_, inverse_;
};

// No weights, of a receiver with too many neighbours.
template <typename Real>
void leave_open(const Kriging& k, Int receiver) {
    constexpr Real none = std::numeric_limits<Real>::quiet_NaN();
    for (int f = 0; f < FUNCTIONALS; ++f) {
        auto* weights = static_cast<Real*>(k.weights[f]);
        static_cast<Real*>(k.own)[f * k.receivers + receiver] = none;
        std::fill(weights + k.offsets[receiver], weights + k.offsets[receiver + 1], none);
    }
}

template <typename Real>
void solve(const Kriging& k) {
    constexpr int lanes = Equations<Real>::lanes;
    const Covariance<Real> covariance(k);
    // Receivers with as many neighbours are solved for together.
    std::vector<Int> order(k.receivers);
    for (Int i = 0; i < k.receivers; ++i) order[i] = i;
    const auto neighbors = [&](Int i) { return k.offsets[i + 1] - k.offsets[i]; };
    std::stable_sort(order.begin(), order.end(), [&](Int a, Int b) { return neighbors(a) < neighbors(b); });
    Int receivers = k.receivers;
    for (; receivers > 0 && neighbors(order[receivers - 1]) > k.most; --receivers)
        leave_open<Real>(k, order[receivers - 1]);
    const Int most = receivers ? 1 + neighbors(order[receivers - 1]) : 1, vectors = (receivers + lanes - 1) / lanes;
#pragma omp parallel
    {
        Equations<Real> equations(most);
#pragma omp for schedule(dynamic, 4)
        for (Int vector = 0; vector < vectors; ++vector) {
            const Int begin = vector * lanes;
            equations.solve(k, covariance, order.data() + begin, static_cast<int>(std::min<Int>(lanes, receivers - begin)));
        }
    }
}

}  // namespace

extern "C" {

void kriging_float32(const Kriging* k) { solve<float>(*k); }
void kriging_float64(const Kriging* k) { solve<double>(*k); }

}  // extern "C"
