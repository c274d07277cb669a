// Sums over pairs of particles within a radius, and the gradients that go back through them.
//
// Each evaluation puts the particles in order of place, finds the pairs and takes them BLOCK at a time, so that nothing
// is ever stored for a pair. A pair is found once, from the row of cells that comes first; what it gives goes to both
// particles. Rows of one colour have no target in common: threads share them, and every particle gets its contributions
// in the same order whatever their number.

#include "cells.hpp"
#include "summands.hpp"

extern "C" {

// What pairs are made of; kernels/pairs.py has the same structures.
struct Particles {
    std::int64_t count, scalars;
    const double *position, *velocity;  // (count, 3)
    const double* scalar;               // (scalars, count)
    const std::uint8_t* wanted;         // (count), whether its sums are asked for
    double length;
    std::int64_t periodic_z;
    double radius, length_unit, velocity_unit;
    std::int64_t mutual;                // whether all summands are, and each pair is evaluated once
};

struct Gradients {
    double *position, *velocity;  // (count, 3)
    double* scalar;               // (scalars, count)
};

}  // extern "C"

namespace {

using namespace eddies;

constexpr int ROWS_TOGETHER = 4;  // of a colour, for one thread

// The results of calls: else the first particle whose position is not finite.
constexpr std::int64_t DONE = -1, UNKNOWN = -2, NO_GRADIENT = -3;

template <typename Real>
std::unique_ptr<Summand<Real>> summand(const Given& given) {
    const Kind& kind = kinds().at(given.kind);
    if constexpr (std::is_same_v<Real, float>) return kind.single(given);
    else return kind.full(given);
}

// Whether all kinds of summands are known, and what is given is what they want; DONE, or what is wrong.
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

// A bit for each of some things.
class Bits {
   public:
    explicit Bits(std::int64_t count) : words_(count / 64 + 2) {}
    void set(std::int64_t number) { words_[number / 64] |= std::uint64_t(1) << number % 64; }
    bool operator[](std::int64_t number) const { return words_[number / 64] >> number % 64 & 1; }

    // The 64 that begin with one of them.
    std::uint64_t from(std::int64_t number) const {
        const std::uint64_t *word = &words_[number / 64], shift = number % 64;
        return word[0] >> shift | (word[1] << 1) << (63 - shift);
    }

   private:
    std::vector<std::uint64_t> words_;
};

// The particles in order of place, each with a record of what it carries in the units of the summands: the bits of its
// turns, velocity, scalars.
template <typename Real>
struct Sorted {
    const Particles& given;
    Cells<Real> cells;
    int width;  // of a record
    Aligned<Real> records;
    Bits wanted;
    std::vector<std::vector<std::int64_t>> colours;  // rows of each

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
    // Each row gets the first colour that no row has whose targets it shares.
    void colour_rows() {
        std::vector<std::vector<std::int64_t>> sources(cells.rows());  // colours that have each row as a target
        std::vector<NearRow> near;
        for (std::int64_t row = 0; row < cells.rows(); ++row) {
            cells.near(row, near);
            std::size_t colour = 0;
            const auto taken = [&](std::size_t candidate) {
                return std::any_of(near.begin(), near.end(), [&](const NearRow& target) {
                    const auto& found = sources[target.row];
                    return target.row >= row &&
                           std::find(found.begin(), found.end(), std::int64_t(candidate)) != found.end();
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

    // Add a particle and those of consecutive others whose bit is set; or them and it.
    void add(std::int64_t i, std::int64_t begin, std::uint64_t others, bool turned) {
        if (!others) return;
        const int number = __builtin_popcountll(others);
        std::fill_n((turned ? second : first) + count, number, static_cast<std::int32_t>(i));
        write_numbers(static_cast<std::int32_t>(begin), others, (turned ? first : second) + count);
        count += number;
    }
};

int components_of(std::int64_t number, const Given* given) {
    std::int64_t found = 0;
    for (std::int64_t s = 0; s < number; ++s) found += given[s].components;
    return static_cast<int>(found);
}

// What one thread does to the rows that it gets.
template <typename Real>
class Worker {
   public:
    std::vector<std::unique_ptr<Summand<Real>>> summands;
    std::vector<Aligned<Real>> by_parameters;  // a vector for each

    // `results` (count, width) in order of place are added to: sums, or where their gradients `by_sums` (count, width
    // of sums) are given, those by position, velocity and scalars, unless null.
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

    // Take all pairs that are found from a row.
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

    // Take what is left.
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
    Queue both_, one_;  // pairs whose particles are both wanted, or the first alone
    Block<Real> pairs_, swapped_;
    ByPairs<Real> by_pairs_;
    Rows<Real> first_, second_;  // what the particles of pairs carry
    int width_;                  // of the record of a particle's sums
    Rows<Real> sums_, others_;

    // Look for neighbours of a particle among a range.
    void look(std::int64_t i, std::int64_t first, std::int64_t last) {
        const auto limit = static_cast<Real>(radius_ * radius_);
        const bool wanted = sorted_.wanted[i];
        const typename Cells<Real>::Turn at[3] = {cells_.turn[0][i], cells_.turn[1][i], cells_.turn[2][i]};
        for (std::int64_t begin = first; begin < last; begin += CANDIDATES) {
            const std::uint64_t asked = sorted_.wanted.from(begin);
            if (!wanted && !asked) continue;
            const int number = static_cast<int>(std::min<std::int64_t>(CANDIDATES, last - begin));
            const std::uint64_t near = cells_.nearer(at, begin, number, limit);
            (wanted ? both_ : one_).add(i, begin, near & asked, !wanted);
            if (wanted) one_.add(i, begin, near & ~asked, false);
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

    // Evaluate the first pairs of a queue, `count` of them, and add what they give: to the first particles, and to the
    // second ones where they are wanted too.
    void take(Queue& queue, int count, bool both) {
        if (count == 0) return;
        std::int32_t *first = queue.first, *second = queue.second;
        for (int p = count; p < BLOCK; ++p) {  // a lane that counts for nothing
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

    // Components of all summands, as rows.
    void evaluate(const Block<Real>& pairs) {
        int column = 0;
        for (auto& summand : summands) {
            summand->values(pairs, reinterpret_cast<Components<Real>>(sums_[column]));
            column += summand->components;
        }
    }

    // What second particles get of mutual summands.
    void turn_sums() {
        int column = 0;
        for (std::size_t s = 0; s < summands.size(); ++s)
            for (int c = 0; c < summands[s]->components; ++c, ++column) {
                Real *row = sums_[column], parity = given_[s].parity[c];
#pragma omp simd
                for (int p = 0; p < BLOCK; ++p) row[p] *= parity;
            }
    }

    // What pairs carry.
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

    // The same pairs with second and first particle in each other's place.
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

    // Gradients of what a block gives to its first particles, and to the second ones if `mutual`.
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

// Let workers take all pairs; `results` as they want them. What belongs to parameters is summed by tasks, in order.
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

// Columns (components, count) of all summands in the caller's order against records (count, width) in order of place.
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
        const Real* found = results.data() + p * sorted.width;
        const std::int64_t row = sorted.cells.order[p];
        for (int axis = 0; axis < 3; ++axis) {
            by.position[3 * row + axis] = found[axis];
            by.velocity[3 * row + axis] = found[3 + axis] / particles.velocity_unit;
        }
        for (std::int64_t s = 0; s < particles.scalars; ++s) by.scalar[s * particles.count + row] = found[6 + s];
    }
    return DONE;
}

}  // namespace

extern "C" {

// The name of a kind of summand, in the order of their names; null beyond the last.
const char* pair_summand(std::int64_t number) {
    if (number >= std::int64_t(kinds().size())) return nullptr;
    return std::next(kinds().begin(), number)->first.c_str();
}

// Sums of all summands; DONE, or what is wrong, and then nothing is found.

std::int64_t pair_sums_float32(const Particles* particles, std::int64_t number, const Given* given) {
    return sums<float>(*particles, number, given);
}

std::int64_t pair_sums_float64(const Particles* particles, std::int64_t number, const Given* given) {
    return sums<double>(*particles, number, given);
}

// Gradients by parameters, and unless `by` holds nulls by what the particles carry, from those by sums, which are zero
// where none are wanted.

std::int64_t pair_gradients_float32(const Particles* particles, std::int64_t number, const Given* given,
                                    const Gradients* by) {
    return gradients<float>(*particles, number, given, *by);
}

std::int64_t pair_gradients_float64(const Particles* particles, std::int64_t number, const Given* given,
                                    const Gradients* by) {
    return gradients<double>(*particles, number, given, *by);
}

}  // extern "C"
