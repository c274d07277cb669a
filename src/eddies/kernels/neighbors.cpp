// Lists of the pairs of points within a radius, and displacements and distances of listed pairs.

#include <memory>

#include "cells.hpp"

extern "C" {

// Receivers and senders, which are points (number, 3); kernels/neighbors.py has the same structures.
struct Search {
    std::int64_t receivers, senders;
    const double *receiver, *sender;
    double length;
    std::int64_t periodic_z;
    double radius;
    std::int64_t exclude_self;  // whether receiver i is sender i, which is not its own neighbour
    std::int64_t* offsets;      // (receivers + 1), where the senders of each receiver begin
};

// The pairs of a list that are within a radius now, for the receivers with the indices `rows` (count). The first of two
// calls fills `first`. Only the second one uses the members after it.
struct Listed {
    std::int64_t count;
    const std::int64_t *rows, *offsets, *listed;
    const double *receivers, *positions;
    double length;
    std::int64_t periodic_z;
    double radius;
    std::int64_t* first;        // (count + 1), where the pairs of each row begin
    std::int64_t *receiver, *segment, *sender;
    void *displacement, *distance;  // (3, pairs) and (pairs)
};

}  // extern "C"

namespace {

using namespace eddies;

constexpr std::int64_t RECEIVERS = 512;  // in a task of a thread

using List = std::vector<std::vector<std::int32_t>>;

// Append the indices of the senders near the receivers begin ... end - 1, and store how many each of them has.
void find(const Search& search, const Cells<double>& cells, std::int64_t begin, std::int64_t end,
          std::vector<std::int32_t>& senders) {
    const double limit = search.radius * search.radius;
    std::vector<NearRow> near;
    std::int64_t last_row = -1;
    Edges edges[2];
    Range ranges[2];
    for (std::int64_t i = begin; i < end; ++i) {
        const auto place = cells.place(search.receiver + 3 * i);
        if (place.row(cells) != last_row) cells.near(last_row = place.row(cells), near);
        cells.edges(place, edges);
        const std::size_t before = senders.size();
        for (const NearRow& row : near) {
            const int number = cells.within(place.fraction[0], edges, row, search.radius, ranges);
            for (int r = 0; r < number; ++r)
                for (std::int64_t at = ranges[r].first; at < ranges[r].last; at += CANDIDATES) {
                    const int some = static_cast<int>(std::min<std::int64_t>(CANDIDATES, ranges[r].last - at));
                    for (auto near = cells.nearer(place.fraction, at, some, limit); near; near &= near - 1) {
                        const std::int32_t j = cells.order[at + __builtin_ctzll(near)];
                        if (!search.exclude_self || j != i) senders.push_back(j);
                    }
                }
        }
        search.offsets[i + 1] = static_cast<std::int64_t>(senders.size() - before);
    }
}

struct Between {
    double x[3], square;
};

inline Between between(const Listed& list, const double* own, const double* other) {
    Between apart;
    apart.square = 0.0;
    for (int axis = 0; axis < 3; ++axis) {
        double d = own[axis] - other[axis];
        if (axis < 2 || list.periodic_z) d -= list.length * std::nearbyint(d / list.length);
        apart.x[axis] = d;
        apart.square += d * d;
    }
    return apart;
}

template <typename Visit>
inline void each_pair(const Listed& list, std::int64_t row, const Visit& visit) {
    const std::int64_t i = list.rows[row];
    const double limit = list.radius * list.radius;
    for (std::int64_t at = list.offsets[i]; at < list.offsets[i + 1]; ++at) {
        const std::int64_t j = list.listed[at];
        const Between apart = between(list, list.receivers + 3 * i, list.positions + 3 * j);
        if (apart.square < limit) visit(i, j, apart);
    }
}

template <typename Real>
void fill(const Listed& list) {
    const std::int64_t pairs = list.first[list.count];
    Real *displacement = static_cast<Real*>(list.displacement), *distance = static_cast<Real*>(list.distance);
#pragma omp parallel for schedule(static)
    for (std::int64_t row = 0; row < list.count; ++row) {
        std::int64_t at = list.first[row];
        each_pair(list, row, [&](std::int64_t i, std::int64_t j, const Between& apart) {
            list.receiver[at] = i;
            list.segment[at] = row;
            list.sender[at] = j;
            Real square = 0;
            for (int axis = 0; axis < 3; ++axis) {
                const Real x = static_cast<Real>(apart.x[axis]);
                displacement[axis * pairs + at] = x;
                square += x * x;
            }
            distance[at] = std::sqrt(square);
            ++at;
        });
    }
}

}  // namespace

extern "C" {

// Fills `offsets` and keeps the list until `neighbors_take`. All positions are finite.
void* neighbors_find(const Search* given) {
    const Search& search = *given;
    Cells<double> cells;
    cells.arrange(search.sender, search.senders, search.receiver, search.receivers, search.length, search.periodic_z,
                  search.radius);
    const std::int64_t parts = (search.receivers + RECEIVERS - 1) / RECEIVERS;
    auto list = std::make_unique<List>(parts);
    search.offsets[0] = 0;
#pragma omp parallel for schedule(dynamic, 1)
    for (std::int64_t part = 0; part < parts; ++part)
        find(search, cells, part * RECEIVERS, std::min((part + 1) * RECEIVERS, search.receivers), (*list)[part]);
    for (std::int64_t i = 0; i < search.receivers; ++i) search.offsets[i + 1] += search.offsets[i];
    return list.release();
}

// Writes the senders of all receivers, and forgets the list.
void neighbors_take(void* kept, std::int64_t* senders) {
    const std::unique_ptr<List> list(static_cast<List*>(kept));
    for (const auto& part : *list) senders = std::copy(part.begin(), part.end(), senders);
}

// Counts the listed pairs that are within the radius, and fills `first`.
void neighbors_count(const Listed* given) {
    const Listed& list = *given;
    list.first[0] = 0;
#pragma omp parallel for schedule(static)
    for (std::int64_t row = 0; row < list.count; ++row) {
        std::int64_t pairs = 0;
        each_pair(list, row, [&](std::int64_t, std::int64_t, const Between&) { ++pairs; });
        list.first[row + 1] = pairs;
    }
    for (std::int64_t row = 0; row < list.count; ++row) list.first[row + 1] += list.first[row];
}

void neighbors_fill_float32(const Listed* list) { fill<float>(*list); }

void neighbors_fill_float64(const Listed* list) { fill<double>(*list); }

}  // extern "C"
