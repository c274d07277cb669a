// Kriging: the weights of the neighbours' values that give the best linear estimate of a random field and of its
// derivatives at a point. The field has a given covariance and an unknown mean; a particle may sit at the point. The
// equations of several receivers are solved together, one in each lane of a vector. No lane's result depends on others.

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "vectors.hpp"

extern "C" {

// Receivers and their neighbours in compressed rows; kernels/kriging.py has the same structure.
struct Kriging {
    std::int64_t receivers, pairs, sited;  // sited: whether receivers are particles, with own values
    const std::int64_t* offsets;    // (receivers + 1,)
    const void* displacement;       // (3, pairs), from a neighbour to its receiver
    double support, noise;          // `noise` is that of a neighbour at the receiver's place
    std::int64_t most;              // largest number of neighbours; the weights of a receiver with more are NaN
    std::int64_t scales;
    double slowest;                 // the covariance is sum_m amplitude_m exp(-slowest 2^m r^2), the widest first
    const double* amplitudes;       // (scales,)
    void* own;                      // (10, receivers)
    void* const* weights;           // ten arrays (pairs,)
};

// Some rows of these weights, and the field whose values they multiply.
struct WeightedSums {
    std::int64_t receivers, rows, columns;
    const std::int64_t *offsets, *senders;
    const void* const* own;         // arrays (receivers,); null if receivers are not particles
    const void* const* weights;     // arrays (pairs,)
    const void* field;              // (particles, columns), the receivers first if they are particles
    void* result;                   // (receivers, columns, rows)
};

}  // extern "C"

namespace {

using eddies::Vector;
using Int = std::int64_t;

// Estimates: the field, its three first and its six second derivatives. One more right-hand side serves the mean.
constexpr int FUNCTIONALS = 10, SIDES = FUNCTIONALS + 1, MOST_SCALES = 8;
// Rows and columns of the six second derivatives.
constexpr int FIRST[6] = {0, 0, 0, 1, 1, 2}, SECOND[6] = {0, 1, 2, 1, 2, 2};

template <typename Real>
inline Vector<Real> all(Real number) {
    return Vector<Real>{} + number;
}

// sum_k (-x)^k / k! up to k = terms.
template <int terms, typename Real>
inline Vector<Real> series_of_exp_minus(Vector<Real> x) {
    double coefficient = 1;
    for (int k = 1; k <= terms; ++k) coefficient /= -k;
    Vector<Real> sum = all<Real>(static_cast<Real>(coefficient));
    for (int k = terms; k > 1; --k) sum = sum * x + static_cast<Real>(coefficient *= -k);
    return 1 + sum * x;
}

// exp(-x) for x >= 0, as 2^-n times the series of the remainder. The error is a few units in the last place. The result
// is 0 where it would be denormal.
template <typename Real>
inline Vector<Real> exp_minus(Vector<Real> x) {
    constexpr bool single = sizeof(Real) == 4;
    constexpr Real most = single ? 87 : 708, shift = single ? Real(12582912) : Real(6755399441055744);
    const auto beyond = x > all<Real>(most);
    x = beyond ? all<Real>(most) : x;
    const Vector<Real> n = (x * Real(-1.4426950408889634) + shift) - shift;  // rounded
    // The remainder, at most ln 2 / 2. ln 2 is split in two parts, the first with few digits.
    constexpr Real high = single ? Real(0.693359375) : Real(0.693147180369123816490);
    constexpr Real low = single ? Real(-2.12194440e-4) : Real(1.90821492927058770002e-10);
    const Vector<Real> fraction = series_of_exp_minus<single ? 7 : 13, Real>((x + n * high) + n * low);
    using Bits = eddies::BitVector<Real>;
    const Bits power = __builtin_convertvector(n, Bits) << (single ? 23 : 52);
    return beyond ? Vector<Real>{} : (Vector<Real>)((Bits)fraction + power);
}

// The covariance as a function of r^2, and its first and second derivative with respect to r^2.
template <typename Real>
struct Covariance {
    Real slowest, amplitudes[MOST_SCALES];
    int scales;
    bool near;  // whether all distances are small enough for the series of the widest part

    explicit Covariance(const Kriging& k)
        : slowest(static_cast<Real>(k.slowest)), scales(static_cast<int>(k.scales)),
          near(4 * k.support * k.support * k.slowest < 1) {
        for (int m = 0; m < scales; ++m) amplitudes[m] = static_cast<Real>(k.amplitudes[m]);
    }

    Vector<Real> widest(Vector<Real> square) const {
        const Vector<Real> x = square * slowest;
        return near ? series_of_exp_minus<sizeof(Real) == 4 ? 10 : 18, Real>(x) : exp_minus<Real>(x);
    }

    Vector<Real> operator()(Vector<Real> square) const {
        Vector<Real> power = widest(square), sum{};
        for (int m = 0; m < scales; ++m, power *= power) sum += amplitudes[m] * power;
        return sum;
    }

    void derivatives(Vector<Real> square, Vector<Real>& first, Vector<Real>& second) const {
        Vector<Real> power = widest(square);
        first = second = Vector<Real>{};
        Real rate = slowest;
        for (int m = 0; m < scales; ++m, power *= power, rate *= 2) {
            first -= rate * amplitudes[m] * power;
            second += rate * rate * amplitudes[m] * power;
        }
    }
};

// The equations of receivers, one in each lane: the lower triangle of the matrix and the right-hand sides, as rows.
template <typename Real>
class Equations {
   public:
    static constexpr int lanes = eddies::VectorOf<Real>::lanes;

    // Rows are an odd number of vectors apart. Otherwise a column would use only a few sets of the cache.
    explicit Equations(Int most)
        : apart_(most | 1), places_(3 * most * lanes), noise_(most * lanes), present_(most * lanes),
          rows_((most + SIDES) * apart_ * lanes), inverse_(most * lanes) {}

    void solve(const Kriging& k, const Covariance<Real>& covariance, const Int* receiver, int count) {
        read(k, receiver, count);
        fill(covariance, k.sited);
        factorise();
        substitute_back();
        leave_means(k.sited);
        write(k, receiver, count);
    }

   private:
    using V = Vector<Real>;
    // Rows and columns of a tile. Its entries, a factor for each column and one for a row fit the 32 or 16 registers.
    static constexpr int TALL = eddies::VECTOR_BYTES == 64 ? 6 : 4, WIDE = eddies::VECTOR_BYTES == 64 ? 4 : 3;
    static_assert(SIDES % TALL > 0);

    V& place(Int j, int axis) { return eddies::vector_at(places_.data() + (3 * j + axis) * lanes); }
    V& noise(Int j) { return eddies::vector_at(noise_.data() + j * lanes); }
    V& present(Int j) { return eddies::vector_at(present_.data() + j * lanes); }
    V* row(Int i) { return reinterpret_cast<V*>(rows_.data() + i * apart_ * lanes); }
    V& inverse(Int j) { return eddies::vector_at(inverse_.data() + j * lanes); }

    // Read positions relative to the receiver, its own first. `present` is 0 where a lane has no more neighbours.
    void read(const Kriging& k, const Int* receiver, int count) {
        const auto* displacement = static_cast<const Real*>(k.displacement);
        const Real reach = static_cast<Real>(1 / (k.support * k.support));
        size_ = 1;
        for (int lane = 0; lane < count; ++lane)
            size_ = std::max(size_, 1 + k.offsets[receiver[lane] + 1] - k.offsets[receiver[lane]]);
        for (Int j = 0; j < size_; ++j) {
            present(j) = noise(j) = V{};
            for (int axis = 0; axis < 3; ++axis) place(j, axis) = V{};
        }
        present(0) = all<Real>(k.sited ? 1 : 0);
        for (int lane = 0; lane < count; ++lane) {
            const Int begin = k.offsets[receiver[lane]], neighbors = k.offsets[receiver[lane] + 1] - begin;
            for (Int j = 0; j < neighbors; ++j) {
                present_.data()[(j + 1) * lanes + lane] = 1;
                for (int axis = 0; axis < 3; ++axis)
                    places_.data()[(3 * (j + 1) + axis) * lanes + lane] = -displacement[axis * k.pairs + begin + j];
            }
        }
        // Neighbours appear and disappear at the support. Their noise there is 1e4 times that beside the receiver.
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

    void fill(const Covariance<Real>& covariance, bool sited) {
        for (Int i = 0; i < size_; ++i) {
            V* entries = row(i);
            for (Int j = 0; j < i; ++j) entries[j] = covariance(square(i, j)) * present(i);  // j > 0 is present, too
            if (i > 0) entries[0] *= present(0);
            entries[i] = (covariance(V{}) + noise(i)) * present(i) + (1 - present(i));
            V first, second;
            covariance.derivatives(square(i, 0), first, second);
            row(size_)[i] = sited ? all<Real>(i == 0) : covariance(square(i, 0)) * present(i);
            row(size_ + FUNCTIONALS)[i] = present(i);
            // Derivatives of C(|x - x_j|^2) with respect to the receiver's place x: the first is -2 C' (x_j - x), the
            // second is 4 C'' (x_j - x) (x_j - x) + 2 C' I.
            for (int axis = 0; axis < 3; ++axis) row(size_ + 1 + axis)[i] = -2 * first * place(i, axis) * present(i);
            for (int q = 0; q < 6; ++q) {
                const V twice = 4 * second * place(i, FIRST[q]) * place(i, SECOND[q]);
                row(size_ + 4 + q)[i] = (FIRST[q] == SECOND[q] ? twice + 2 * first : twice) * present(i);
            }
        }
    }

    // Replace the matrix L L^T by its Cholesky factor L, and the right-hand sides b by L^-1 b. A few rows at a time are
    // reduced by the rows above, in tiles whose entries stay in registers.
    void factorise() {
        const Int all_rows = size_ + SIDES;
        for (Int begin = 0; begin < all_rows; begin += TALL) {
            V* some[TALL];
            const int count = static_cast<int>(std::min<Int>(TALL, all_rows - begin));
            for (int r = 0; r < TALL; ++r) some[r] = row(begin + std::min(r, count - 1));
            const Int above = std::min(begin, size_);
            Int j = 0;
            for (; j + WIDE <= above; j += WIDE) tile(some, count, j);
            for (; j < size_ && j < begin + count; ++j) column(some, count, begin, j);
        }
    }

    void tile(V* const* some, int count, Int first) {
        const V* given[WIDE];
        V sum[TALL][WIDE];
        for (int c = 0; c < WIDE; ++c) {
            given[c] = row(first + c);
            for (int r = 0; r < TALL; ++r) sum[r][c] = some[r][first + c];
        }
        for (Int k = 0; k < first; ++k)
            for (int r = 0; r < TALL; ++r)
                for (int c = 0; c < WIDE; ++c) sum[r][c] -= some[r][k] * given[c][k];
        for (int c = 0; c < WIDE; ++c)
            for (int r = 0; r < TALL; ++r) {
                for (int before = 0; before < c; ++before) sum[r][c] -= sum[r][before] * given[c][first + before];
                sum[r][c] *= inverse(first + c);
            }
        for (int r = 0; r < count; ++r)
            for (int c = 0; c < WIDE; ++c) some[r][first + c] = sum[r][c];
    }

    // Reduce column j of the rows from `begin` on. One of these rows may end in this column, on the diagonal.
    void column(V* const* some, int count, Int begin, Int j) {
        const V* given = row(j);
        V sum[TALL];
        for (int r = 0; r < TALL; ++r) sum[r] = some[r][j];
        for (Int k = 0; k < j; ++k)
            for (int r = 0; r < TALL; ++r) sum[r] -= some[r][k] * given[k];
        if (j >= begin) inverse(j) = 1 / root(sum[j - begin]);
        for (int r = 0; r < count; ++r)
            if (begin + r > j) some[r][j] = sum[r] * inverse(j);
    }

    static V root(V square) {
        for (int lane = 0; lane < lanes; ++lane) square[lane] = std::sqrt(square[lane]);
        return square;
    }

    // Multiply the right-hand sides by L^-T, a few columns at a time, the last columns first.
    void substitute_back() {
        Int end = size_;
        for (Int begin = (size_ - 1) / WIDE * WIDE; begin >= 0; end = begin, begin -= WIDE) {
            const bool whole = end - begin == WIDE;  // in every step but the first
            for (int f = 0; f < SIDES; ++f) {
                V* solution = row(size_ + f);
                for (Int k = end - 1; k >= begin; --k) {
                    const V last = solution[k] *= inverse(k);
                    for (Int j = begin; j < k; ++j) solution[j] -= row(k)[j] * last;
                }
                if (!whole)
                    for (Int k = begin; k < end; ++k)
                        for (Int j = 0; j < begin; ++j) solution[j] -= row(k)[j] * solution[k];
            }
            if (whole) {
                int f = 0;
                for (; f + TALL <= SIDES; f += TALL) take_off<TALL>(f, begin);
                take_off<SIDES % TALL>(f, begin);
            }
        }
    }

    // Subtract the share of the solved columns, which begin at `begin`, from the columns before them.
    template <int COUNT>
    void take_off(int f, Int begin) {
        V* solution[COUNT];
        const V* given[WIDE];
        V last[COUNT][WIDE];
        for (int c = 0; c < WIDE; ++c) given[c] = row(begin + c);
        for (int r = 0; r < COUNT; ++r) {
            solution[r] = row(size_ + f + r);
            for (int c = 0; c < WIDE; ++c) last[r][c] = solution[r][begin + c];
        }
        for (Int j = 0; j < begin; ++j)
            for (int r = 0; r < COUNT; ++r) {
                V sum = solution[r][j];
                for (int c = 0; c < WIDE; ++c) sum -= given[c][j] * last[r][c];
                solution[r][j] = sum;
            }
    }

    // The mean of the field is unknown. A multiple of K^-1 1 is subtracted so that the weights add up to zero, or to
    // one for the field itself at a receiver that is not a particle.
    void leave_means(bool sited) {
        const V* ones = row(size_ + FUNCTIONALS);
        V whole{};
        for (Int j = 0; j < size_; ++j) whole += ones[j];
        for (int f = 0; f < FUNCTIONALS; ++f) {
            V* solution = row(size_ + f);
            V part = all<Real>(f == 0 && !sited ? -1 : 0);
            for (Int j = 0; j < size_; ++j) part += solution[j];
            part /= whole;
            for (Int j = 0; j < size_; ++j) solution[j] -= part * ones[j];
        }
    }

    void write(const Kriging& k, const Int* receiver, int count) {
        auto* own = static_cast<Real*>(k.own);
        for (int f = 0; f < FUNCTIONALS; ++f) {
            const auto* solution = reinterpret_cast<const Real*>(row(size_ + f));
            auto* weights = static_cast<Real*>(k.weights[f]);
            for (int lane = 0; lane < count; ++lane) {
                const Int begin = k.offsets[receiver[lane]], neighbors = k.offsets[receiver[lane] + 1] - begin;
                own[f * k.receivers + receiver[lane]] = solution[lane];
                for (Int j = 0; j < neighbors; ++j) weights[begin + j] = solution[(j + 1) * lanes + lane];
            }
        }
    }

    Int apart_, size_ = 0;
    eddies::Aligned<Real> places_, noise_, present_, rows_, inverse_;
};

// Set the weights of a receiver with too many neighbours to NaN.
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
    // Receivers with equally many neighbours are solved together.
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
            const Int begin = vector * lanes, count = std::min<Int>(lanes, receivers - begin);
            equations.solve(k, covariance, order.data() + begin, static_cast<int>(count));
        }
    }
}

template <typename Real>
inline Real sum_of_lanes(Vector<Real> numbers) {
    constexpr int lanes = eddies::VectorOf<Real>::lanes;
    for (int apart = lanes / 2; apart > 0; apart /= 2) {
        eddies::BitVector<Real> other;
        for (int lane = 0; lane < lanes; ++lane) other[lane] = lane ^ apart;
        numbers += __builtin_shuffle(numbers, other);
    }
    return numbers[0];
}

template <typename Real, int ROWS>
void sum_weighted(const WeightedSums& t) {
    constexpr int lanes = eddies::VectorOf<Real>::lanes;
    const auto* field = static_cast<const Real*>(t.field);
    const Real *own[ROWS], *weights[ROWS];
    for (int r = 0; r < ROWS; ++r) {
        own[r] = t.own ? static_cast<const Real*>(t.own[r]) : nullptr;
        weights[r] = static_cast<const Real*>(t.weights[r]);
    }
#pragma omp parallel for schedule(static)
    for (Int i = 0; i < t.receivers; ++i)
        for (Int c = 0; c < t.columns; ++c) {
            Vector<Real> sums[ROWS] = {};
            Real rest[ROWS];
            for (int r = 0; r < ROWS; ++r) rest[r] = t.own ? own[r][i] * field[i * t.columns + c] : Real(0);
            Int pair = t.offsets[i];
            const Int end = t.offsets[i + 1];
            for (; pair + lanes <= end; pair += lanes) {
                Vector<Real> sent;
                for (int lane = 0; lane < lanes; ++lane) sent[lane] = field[t.senders[pair + lane] * t.columns + c];
                for (int r = 0; r < ROWS; ++r) sums[r] += eddies::unaligned(weights[r] + pair) * sent;
            }
            for (; pair < end; ++pair) {
                const Real sent = field[t.senders[pair] * t.columns + c];
                for (int r = 0; r < ROWS; ++r) rest[r] += weights[r][pair] * sent;
            }
            Real* result = static_cast<Real*>(t.result) + (i * t.columns + c) * ROWS;
            for (int r = 0; r < ROWS; ++r) result[r] = rest[r] + sum_of_lanes<Real>(sums[r]);
        }
}

// The rows are all ten, those of the field and its gradient, those of the gradient, or one.
template <typename Real>
void sum_weighted(const WeightedSums& t) {
    if (t.rows == FUNCTIONALS) sum_weighted<Real, FUNCTIONALS>(t);
    else if (t.rows == 4) sum_weighted<Real, 4>(t);
    else if (t.rows == 3) sum_weighted<Real, 3>(t);
    else sum_weighted<Real, 1>(t);
}

}  // namespace

extern "C" {

void kriging_float32(const Kriging* k) { solve<float>(*k); }
void kriging_float64(const Kriging* k) { solve<double>(*k); }

void weighted_sums_float32(const WeightedSums* t) { sum_weighted<float>(*t); }
void weighted_sums_float64(const WeightedSums* t) { sum_weighted<double>(*t); }

}  // extern "C"
