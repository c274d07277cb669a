// Sums over pairs of particles within a radius, and the gradients that go back through them.
//
// Each evaluation sorts the particles by place, searches the pairs and processes them in blocks of BLOCK, so that
// nothing is stored for a pair. A pair is found once, from the first of its two rows of cells, and contributes to both
// particles. The targets of a row are the rows to whose particles it contributes. Two rows of one colour have no target
// in common, so threads can process them at the same time. Every particle gets its contributions in the same order for
// any number of threads.

#include "cells.hpp"
#include "summands.hpp"

extern "C" {

// Particles and their columns; kernels/pairs.py has the same structures.
struct Particles {
    std::int64_t count, scalars;
    const double *position, *velocity;  // (count, 3)
    const double* scalar;               // (scalars, count)
    const std::uint8_t* wanted;         // (count), whether its sums are requested
    double length;
    std::int64_t periodic_z;
    double radius, length_unit, velocity_unit;
    std::int64_t mutual;                // whether all summands are mutual, so that each pair is evaluated once
};

struct Gradients {
    double *position, *velocity;  // (count, 3)
    double* scalar;               // (scalars, count)
};

}  // extern "C"

namespace {

using namespace eddies;

constexpr int ROWS_TOGETHER = 4;  // rows of a colour that a thread takes at a time

// Results of calls. Any other result is the number of the first particle whose position is not finite.
constexpr std::int64_t DONE = -1, UNKNOWN = -2, NO_GRADIENT = -3;

template <typename Real>
std::unique_ptr<Summand<Real>> summand(const Given& given) {
    const Kind& kind = kinds().at(given.kind);
    if constexpr (std::is_same_v<Real, float>) return kind.single(given);
    else return kind.full(given);
}

// Check the kinds of the summands and their arguments: DONE, or an error.
std::int64_t check(const Particles& particles, std::int64_t number, const Given* given, bool gradients) try {
    for (std::int64_t s = 0; s < number; ++s) {
        const auto one = summand<double>(given[s]);
        if (one->components != given[s].components || one->parameters != given[s].parameters_count ||
            given[s].scalar + one->scalars > particles.scalars)
            return UNKNOWN;
        if (gradients && !one->differentiable) return NO_GRADIENT;
    }
    return DONE;
} catch (const std::logic_error&) {  // no such name, or not the parameters of such a network
    return UNKNOWN;
}

// A set of bits.
class Bits {
   public:
    explicit Bits(std::int64_t count) : words_(count / 64 + 2) {}
    void set(std::int64_t number) { words_[number / 64] |= std::uint64_t(1) << number % 64; }
    bool operator[](std::int64_t number) const { return words_[number / 64] >> number % 64 & 1; }

    // 64 bits from a position on.
    std::uint64_t from(std::int64_t number) const {
        const std::uint64_t *word = &words_[number / 64], shift = number % 64;
        return word[0] >> shift | (word[1] << 1) << (63 - shift);
    }

   private:
    std::vector<std::uint64_t> words_;
};

// The sorted particles, each with a record in the units of the summands: bits of its turns, velocity, scalars.
template <typename Real>
struct Sorted {
    const Particles& given;
    Cells<Real> cells;
    int width;  // of a record
    Aligned<Real> records;
    Bits wanted;
    std::vector<std::vector<std::int64_t>> colours;  // rows of each colour

    explicit Sorted(const Particles& given)
        : given(given), width(padded<Real>(6 + static_cast<int>(given.scalars))), records(given.count * width),
          wanted(given.count) {}

    std::int64_t arrange() {
        const std::int64_t misplaced = not_finite(given.position, given.count);
        if (misplaced >= 0) return misplaced;
        cells.arrange(given.position, given.count, nullptr, 0, given.length, given.periodic_z, given.radius);
#pragma omp parallel for schedule(static)
        for (std::int64_t p = 0; p < given.count; ++p) {
            Real* record = records.data() + p * width;
            const std::int64_t row = cells.order[p];
            for (int axis = 0; axis < 3; ++axis) {
                std::memcpy(record + axis, &cells.turn[axis][p], sizeof(Real));
                record[3 + axis] = static_cast<Real>(given.velocity[3 * row + axis] / given.velocity_unit);
            }
            for (std::int64_t s = 0; s < given.scalars; ++s)
                record[6 + s] = static_cast<Real>(given.scalar[s * given.count + row]);
        }
        for (std::int64_t p = 0; p < given.count; ++p)
            if (given.wanted[cells.order[p]]) wanted.set(p);
        colour_rows();
        return DONE;
    }

   private:
    // Give each row the first colour in which no other row has a target in common with it.
    void colour_rows() {
        std::vector<std::vector<std::int64_t>> sources(cells.rows());  // colours of the rows with each target
        std::vector<NearRow> near;
        for (std::int64_t row = 0; row < cells.rows(); ++row) {
            cells.near(row, near);
            std::size_t colour = 0;
            const auto taken = [&](std::size_t candidate) {
                return std::any_of(near.begin(), near.end(), [&](const NearRow& target) {
                    const auto& used = sources[target.row];
                    return target.row >= row &&
                           std::find(used.begin(), used.end(), std::int64_t(candidate)) != used.end();
                });
            };
            while (taken(colour)) ++colour;
            if (colour == colours.size()) colours.emplace_back();
            colours[colour].push_back(row);
            for (const NearRow& target : near)
                if (target.row >= row) sources[target.row].push_back(std::int64_t(colour));
        }
    }
};

// Pairs that wait to be evaluated.
struct Queue {
    int count = 0;
    std::int32_t first[BLOCK + 2 * CANDIDATES], second[BLOCK + 2 * CANDIDATES];

    // Add the pairs of particle i with those particles from `begin` on whose bit is set in `others`. If `turned`,
    // particle i is the second one of each pair.
    void add(std::int64_t i, std::int64_t begin, std::uint64_t others, bool turned) {
        if (!others) return;
        const int number = __builtin_popcountll(others);
        std::fill_n((turned ? second : first) + count, number, static_cast<std::int32_t>(i));
        write_numbers(static_cast<std::int32_t>(begin), others, (turned ? first : second) + count);
        count += number;
    }
};

int components_of(std::int64_t number, const Given* given) {
    std::int64_t sum = 0;
    for (std::int64_t s = 0; s < number; ++s) sum += given[s].components;
    return static_cast<int>(sum);
}

// The work of one thread on its rows.
template <typename Real>
class Worker {
   public:
    std::vector<std::unique_ptr<Summand<Real>>> summands;
    std::vector<Aligned<Real>> by_parameters;  // for each summand, a vector for each parameter

    // The worker adds to `results` (count, width), the records of the sorted particles. If `by_sums` is null, these are
    // the sums. Otherwise `by_sums` (count, width of sums) are the gradients with respect to the sums, and `results`
    // are the gradients with respect to position, velocity and scalars, or null.
    Worker(const Sorted<Real>& sorted, std::int64_t number, const Given* given, Real* results, const Real* by_sums)
        : given_(given), sorted_(sorted), cells_(sorted.cells), results_(results), by_sums_(by_sums),
          by_pairs_(sorted.width), first_(sorted.width), second_(sorted.width),
          width_(padded<Real>(components_of(number, given))), sums_(width_), others_(width_) {
        for (std::int64_t s = 0; s < number; ++s) {
            summands.push_back(summand<Real>(given[s]));
            by_parameters.emplace_back(given[s].parameters_count * VectorOf<Real>::lanes);
        }
        const Particles& particles = sorted.given;
        radius_ = particles.radius;
        unit_ = static_cast<Real>(1 / particles.length_unit);
        const auto scaled = static_cast<Real>(particles.radius / particles.length_unit);
        inverse_square_ = 1 / (scaled * scaled);
    }

    // Process all pairs of a row.
    void row(std::int64_t row) {
        const Range own = cells_.of_row(row);
        cells_.near(row, near_);
        columns_.resize(own.last - own.first);
        Range ranges[2];
        for (const NearRow& other : near_) {
            if (other.row < row) continue;
            cells_.columns_within(row, other, radius_, columns_.data());
            for (std::int64_t i = own.first; i < own.last; ++i) {
                const Columns& columns = columns_[i - own.first];
                if (columns.last < columns.first) continue;
                const int number = cells_.pieces(other.row, columns.first, columns.last, ranges);
                for (int r = 0; r < number; ++r)
                    look(i, other.row == row ? std::max(ranges[r].first, i + 1) : ranges[r].first, ranges[r].last);
            }
        }
    }

    // Process the remaining pairs.
    void finish() {
        take(both_, both_.count, true);
        take(one_, one_.count, false);
        both_.count = one_.count = 0;
    }

   private:
    const Given* given_;
    const Sorted<Real>& sorted_;
    const Cells<Real>& cells_;
    Real* results_;
    const Real* by_sums_;
    double radius_;
    Real unit_, inverse_square_;
    std::vector<NearRow> near_;
    std::vector<Columns> columns_;
    Queue both_, one_;  // pairs with both particles wanted, or only the first
    Block<Real> pairs_, swapped_;
    ByPairs<Real> by_pairs_;
    Rows<Real> first_, second_;  // records of the particles of pairs
    int width_;                  // of the record of a particle's sums
    Rows<Real> sums_, others_;

    // Search the neighbours of particle i in a range.
    void look(std::int64_t i, std::int64_t first, std::int64_t last) {
        const auto limit = static_cast<Real>(radius_ * radius_);
        const bool wanted = sorted_.wanted[i];
        const typename Cells<Real>::Turn at[3] = {cells_.turn[0][i], cells_.turn[1][i], cells_.turn[2][i]};
        for (std::int64_t begin = first; begin < last; begin += CANDIDATES) {
            const std::uint64_t others = sorted_.wanted.from(begin);
            if (!wanted && !others) continue;
            const int number = static_cast<int>(std::min<std::int64_t>(CANDIDATES, last - begin));
            const std::uint64_t near = cells_.nearer(at, begin, number, limit);
            (wanted ? both_ : one_).add(i, begin, near & others, !wanted);
            if (wanted) one_.add(i, begin, near & ~others, false);
            take_blocks(both_, true);
            take_blocks(one_, false);
        }
    }

    void take_blocks(Queue& queue, bool both) {
        if (queue.count < BLOCK) return;
        take(queue, BLOCK, both);
        queue.count -= BLOCK;
        std::memmove(queue.first, queue.first + BLOCK, queue.count * sizeof(*queue.first));
        std::memmove(queue.second, queue.second + BLOCK, queue.count * sizeof(*queue.second));
    }

    // Evaluate the first `count` pairs of a queue. Add the values to the first particles, and to the second ones if
    // these are wanted too.
    void take(Queue& queue, int count, bool both) {
        if (count == 0) return;
        std::int32_t *first = queue.first, *second = queue.second;
        for (int p = count; p < BLOCK; ++p) {  // unused lanes
            first[p] = first[0];
            second[p] = second[0];
        }
        make_pairs(first, second);
        const bool mutual = sorted_.given.mutual;
        if (by_sums_) {
            take_back(pairs_, first, second, count, mutual && both);
            if (!mutual && both) take_back(swapped(), second, first, count, false);
            return;
        }
        evaluate(pairs_);
        scatter_add(sums_[0], width_, first, count, results_);
        if (!both) return;
        if (mutual) turn_sums();
        else evaluate(swapped());
        scatter_add(sums_[0], width_, second, count, results_);
    }

    // Evaluate the components of all summands, as rows.
    void evaluate(const Block<Real>& pairs) {
        int column = 0;
        for (auto& summand : summands) {
            summand->values(pairs, reinterpret_cast<Components<Real>>(sums_[column]));
            column += summand->components;
        }
    }

    // Replace the contributions of mutual summands to the first particles by those to the second ones.
    void turn_sums() {
        int column = 0;
        for (std::size_t s = 0; s < summands.size(); ++s)
            for (int c = 0; c < summands[s]->components; ++c, ++column) {
                Real *row = sums_[column], parity = given_[s].parity[c];
#pragma omp simd
                for (int p = 0; p < BLOCK; ++p) row[p] *= parity;
            }
    }

    // Compute the quantities of pairs.
    void make_pairs(const std::int32_t* first, const std::int32_t* second) {
        using V = Vector<Real>;
        gather(sorted_.records.data(), sorted_.width, first, first_[0]);
        gather(sorted_.records.data(), sorted_.width, second, second_[0]);
        for (int p = 0; p < BLOCK; p += VectorOf<Real>::lanes) {
            V square{};
            for (int axis = 0; axis < 3; ++axis) {
                const V x = Turns<Real>::difference(lanes(first_, axis, p), lanes(second_, axis, p)) *
                            (cells_.scale[axis] * unit_);
                *reinterpret_cast<V*>(pairs_.x[axis] + p) = x;
                *reinterpret_cast<V*>(pairs_.v[axis] + p) =
                    lanes(first_, 3 + axis, p) - lanes(second_, 3 + axis, p);
                square += x * x;
            }
            const V inside = Real(1) - square * inverse_square_, left = inside > Real(0) ? inside : V{};
            *reinterpret_cast<V*>(pairs_.weight + p) = left * left;
            for (int lane = 0; lane < VectorOf<Real>::lanes; ++lane)
                pairs_.distance[p + lane] = std::sqrt(square[lane]);
        }
        for (std::int64_t s = 0; s < sorted_.given.scalars; ++s) {
            pairs_.scalar[0][s] = first_[static_cast<int>(6 + s)];
            pairs_.scalar[1][s] = second_[static_cast<int>(6 + s)];
        }
    }

    static Vector<Real> lanes(const Rows<Real>& rows, int row, int p) {
        return *reinterpret_cast<const Vector<Real>*>(rows[row] + p);
    }

    // The same pairs with exchanged particles.
    const Block<Real>& swapped() {
        for (int axis = 0; axis < 3; ++axis)
#pragma omp simd
            for (int p = 0; p < BLOCK; ++p) {
                swapped_.x[axis][p] = -pairs_.x[axis][p];
                swapped_.v[axis][p] = -pairs_.v[axis][p];
            }
        std::copy(pairs_.distance, pairs_.distance + BLOCK, swapped_.distance);
        std::copy(pairs_.weight, pairs_.weight + BLOCK, swapped_.weight);
        for (int s = 0; s < MOST_SCALARS; ++s) {
            swapped_.scalar[0][s] = pairs_.scalar[1][s];
            swapped_.scalar[1][s] = pairs_.scalar[0][s];
        }
        return swapped_;
    }

    // Add the gradients of the contributions of a block to its first particles, and to the second ones if `mutual`.
    void take_back(const Block<Real>& pairs, const std::int32_t* first, const std::int32_t* second, int count,
                   bool mutual) {
        gather(by_sums_, width_, first, sums_[0]);
        if (mutual) gather(by_sums_, width_, second, others_[0]);
        if (results_) by_pairs_.clear();
        int column = 0;
        for (std::size_t s = 0; s < summands.size(); ++s) {
            Summand<Real>& summand = *summands[s];
            for (int c = 0; c < summand.components; ++c) {
                Real* given = sums_[column + c];
                if (mutual) {
                    const Real *other = others_[column + c], parity = given_[s].parity[c];
#pragma omp simd
                    for (int p = 0; p < BLOCK; ++p) given[p] += parity * other[p];
                }
                std::fill(given + count, given + BLOCK, Real(0));
            }
            summand.gradients(pairs, reinterpret_cast<GivenComponents<Real>>(sums_[column]),
                              results_ ? &by_pairs_ : nullptr, by_parameters[s].data());
            column += summand.components;
        }
        if (results_) add_back(pairs, first, second, count);
    }

    void add_back(const Block<Real>& pairs, const std::int32_t* first, const std::int32_t* second, int count) {
        ByPairs<Real>& by = by_pairs_;
#pragma omp simd
        for (int p = 0; p < BLOCK; ++p) {
            const Real r = pairs.distance[p], inside = 1 - r * r * inverse_square_;
            const Real along = (r > 0 ? by.distance[p] / r : Real(0)) -
                               (inside > 0 ? by.weight[p] * 4 * inside * inverse_square_ : Real(0));
            for (int axis = 0; axis < 3; ++axis) by.x[axis][p] = (by.x[axis][p] + along * pairs.x[axis][p]) * unit_;
        }
        for (int row = 0; row < 6; ++row) {
            const Real* own = by.first[row];
            Real* other = by.second[row];
#pragma omp simd
            for (int p = 0; p < BLOCK; ++p) other[p] = -own[p];
        }
        scatter_add(by.first[0], by.width, first, count, results_);
        scatter_add(by.second[0], by.width, second, count, results_);
    }
};

// Let workers process all pairs; `results` is as in Worker. Gradients with respect to parameters are summed over the
// tasks in order.
template <typename Real>
void take_all(const Sorted<Real>& sorted, std::int64_t number, const Given* given, Real* results, const Real* by_sums) {
    struct Task {
        std::size_t colour;
        std::size_t begin, end;
    };
    std::vector<Task> tasks;
    std::vector<std::size_t> bounds(1, 0);  // first task of each colour
    for (std::size_t colour = 0; colour < sorted.colours.size(); ++colour) {
        const std::size_t rows = sorted.colours[colour].size();
        for (std::size_t begin = 0; begin < rows; begin += ROWS_TOGETHER)
            tasks.push_back({colour, begin, std::min(begin + ROWS_TOGETHER, rows)});
        bounds.push_back(tasks.size());
    }
    std::int64_t parameters = 0;
    for (std::int64_t s = 0; s < number; ++s) parameters += given[s].parameters_count;
    std::vector<double> by_task(by_sums ? tasks.size() * parameters : 0);
#pragma omp parallel
    {
        Worker<Real> worker(sorted, number, given, results, by_sums);
        for (std::size_t colour = 0; colour + 1 < bounds.size(); ++colour) {
#pragma omp for schedule(dynamic, 1)
            for (std::size_t t = bounds[colour]; t < bounds[colour + 1]; ++t) {
                for (std::size_t r = tasks[t].begin; r < tasks[t].end; ++r) worker.row(sorted.colours[colour][r]);
                worker.finish();
                if (!by_sums) continue;
                double* place = by_task.data() + t * parameters;
                for (std::int64_t s = 0; s < number; ++s) {
                    Real* lane = worker.by_parameters[s].data();
                    for (std::int64_t q = 0; q < given[s].parameters_count; ++q, ++place)
                        for (int end = 0; end < VectorOf<Real>::lanes; ++end, ++lane) {
                            *place += *lane;
                            *lane = 0;
                        }
                }
            }
        }
    }
    if (!by_sums) return;
    std::int64_t column = 0;
    for (std::int64_t s = 0; s < number; ++s)
        for (std::int64_t q = 0; q < given[s].parameters_count; ++q, ++column) {
            double sum = 0.0;
            for (std::size_t t = 0; t < tasks.size(); ++t) sum += by_task[t * parameters + column];
            given[s].by_parameters[q] = sum;
        }
}

// Call move(summand, index in the caller's array (components, count), particle, column) for all components and
// particles. The last two are the place of the number in the records (count, width) of the sorted particles.
template <typename Real, typename Move>
void each_column(const Sorted<Real>& sorted, std::int64_t number, const Given* given, const Move& move) {
    std::int64_t column = 0;
    for (std::int64_t s = 0; s < number; ++s)
        for (std::int64_t c = 0; c < given[s].components; ++c, ++column)
#pragma omp parallel for schedule(static)
            for (std::int64_t p = 0; p < sorted.given.count; ++p)
                move(given[s], c * sorted.given.count + sorted.cells.order[p], p, column);
}

template <typename Real>
std::int64_t sums(const Particles& particles, std::int64_t number, const Given* given) {
    if (const std::int64_t wrong = check(particles, number, given, false); wrong != DONE) return wrong;
    Sorted<Real> sorted(particles);
    if (const std::int64_t misplaced = sorted.arrange(); misplaced != DONE) return misplaced;
    const int width = padded<Real>(components_of(number, given));
    Aligned<Real> results(particles.count * width);
    take_all<Real>(sorted, number, given, results.data(), nullptr);
    each_column(sorted, number, given, [&](const Given& one, std::int64_t row, std::int64_t place,
                                           std::int64_t column) {
        static_cast<Real*>(one.sums)[row] = results.data()[place * width + column];
    });
    return DONE;
}

template <typename Real>
std::int64_t gradients(const Particles& particles, std::int64_t number, const Given* given, const Gradients& by) {
    if (const std::int64_t wrong = check(particles, number, given, true); wrong != DONE) return wrong;
    Sorted<Real> sorted(particles);
    if (const std::int64_t misplaced = sorted.arrange(); misplaced != DONE) return misplaced;
    const int width = padded<Real>(components_of(number, given));
    Aligned<Real> by_sums(particles.count * width), results(by.position ? particles.count * sorted.width : 0);
    each_column(sorted, number, given, [&](const Given& one, std::int64_t row, std::int64_t place,
                                           std::int64_t column) {
        by_sums.data()[place * width + column] = static_cast<const Real*>(one.by_sums)[row];
    });
    take_all<Real>(sorted, number, given, by.position ? results.data() : nullptr, by_sums.data());
    if (!by.position) return DONE;
    for (std::int64_t p = 0; p < particles.count; ++p) {
        const Real* record = results.data() + p * sorted.width;
        const std::int64_t row = sorted.cells.order[p];
        for (int axis = 0; axis < 3; ++axis) {
            by.position[3 * row + axis] = record[axis];
            by.velocity[3 * row + axis] = record[3 + axis] / particles.velocity_unit;
        }
        for (std::int64_t s = 0; s < particles.scalars; ++s) by.scalar[s * particles.count + row] = record[6 + s];
    }
    return DONE;
}

}  // namespace

extern "C" {

// The name of the kind of summand with this number, in alphabetical order; null beyond the last.
const char* pair_summand(std::int64_t number) {
    if (number >= std::int64_t(kinds().size())) return nullptr;
    return std::next(kinds().begin(), number)->first.c_str();
}

// Compute the sums of all summands. Returns DONE, or an error; the sums are then not computed.

std::int64_t pair_sums_float32(const Particles* particles, std::int64_t number, const Given* given) {
    return sums<float>(*particles, number, given);
}

std::int64_t pair_sums_float64(const Particles* particles, std::int64_t number, const Given* given) {
    return sums<double>(*particles, number, given);
}

// Compute the gradients with respect to the parameters and, unless `by` holds null pointers, with respect to the
// columns of the particles. The given gradients with respect to the sums are zero at particles that are not wanted.

std::int64_t pair_gradients_float32(const Particles* particles, std::int64_t number, const Given* given,
                                    const Gradients* by) {
    return gradients<float>(*particles, number, given, *by);
}

std::int64_t pair_gradients_float64(const Particles* particles, std::int64_t number, const Given* given,
                                    const Gradients* by) {
    return gradients<double>(*particles, number, given, *by);
}

}  // extern "C"
