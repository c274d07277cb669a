// Numbers that are worked on together: a register of the processor, blocks of points, and records of numbers that
// belong to one point against rows of one number for each point of a block.

#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <memory>

namespace eddies {

constexpr int BLOCK = 64;  // points

#ifdef __AVX512F__
constexpr int VECTOR_BYTES = 64;
#else
constexpr int VECTOR_BYTES = 32;
#endif

template <typename Real>
struct VectorOf {
    typedef Real type __attribute__((vector_size(VECTOR_BYTES), may_alias));
    static constexpr int lanes = VECTOR_BYTES / sizeof(Real);
};

template <typename Real>
using Vector = typename VectorOf<Real>::type;

// Whole numbers of as many bits.
template <typename Real>
struct BitsOf;

template <>
struct BitsOf<float> {
    using type = std::int32_t;
};

template <>
struct BitsOf<double> {
    using type = std::int64_t;
};

template <typename Real>
struct BitVectorOf {
    typedef typename BitsOf<Real>::type type __attribute__((vector_size(VECTOR_BYTES), may_alias));
};

template <typename Real>
using BitVector = typename BitVectorOf<Real>::type;

// Numbers that begin where a vector may, zero at first.
template <typename Real>
class Aligned {
   public:
    explicit Aligned(std::size_t count)
        : numbers_(static_cast<Real*>(std::aligned_alloc(64, (count * sizeof(Real) / 64 + 1) * 64)), &std::free) {
        std::fill_n(numbers_.get(), count, Real(0));
    }
    Real* data() { return numbers_.get(); }
    const Real* data() const { return numbers_.get(); }

   private:
    std::unique_ptr<Real, decltype(&std::free)> numbers_;
};

// Rows of a block.
template <typename Real>
class Rows {
   public:
    explicit Rows(int rows) : numbers_(rows * BLOCK) {}
    Real* operator[](int row) { return numbers_.data() + row * BLOCK; }
    const Real* operator[](int row) const { return numbers_.data() + row * BLOCK; }

   private:
    Aligned<Real> numbers_;
};

// One of `lanes` vectors against one lane of all of them: lane `stage` apart after lane changes places.
template <typename Real, int stage>
inline void transpose(Vector<Real>* rows) {
    constexpr int lanes = VectorOf<Real>::lanes;
    if constexpr (stage < lanes) {
        BitVector<Real> low, high;
        for (int lane = 0; lane < lanes; ++lane) {
            const bool second = lane & stage;
            low[lane] = second ? lanes + lane - stage : lane;
            high[lane] = second ? lanes + lane : lane + stage;
        }
        for (int row = 0; row < lanes; ++row) {
            if (row & stage) continue;
            const Vector<Real> a = rows[row], b = rows[row + stage];
            rows[row] = __builtin_shuffle(a, b, low);
            rows[row + stage] = __builtin_shuffle(a, b, high);
        }
        transpose<Real, 2 * stage>(rows);
    }
}

// Rows (width, BLOCK) of the records (.., width) of numbered points; the width is a whole number of vectors.
template <typename Real>
inline void gather(const Real* records, int width, const std::int32_t* number, Real* rows) {
    using V = Vector<Real>;
    constexpr int lanes = VectorOf<Real>::lanes;
    for (int begin = 0; begin < width; begin += lanes)
        for (int p = 0; p < BLOCK; p += lanes) {
            V part[lanes];
            for (int q = 0; q < lanes; ++q)
                part[q] = *reinterpret_cast<const V*>(records + std::int64_t(number[p + q]) * width + begin);
            transpose<Real, 1>(part);
            for (int q = 0; q < lanes; ++q) *reinterpret_cast<V*>(rows + (begin + q) * BLOCK + p) = part[q];
        }
}

// Adds rows, of the first `count` points of a block, to their records.
template <typename Real>
inline void scatter_add(const Real* rows, int width, const std::int32_t* number, int count, Real* records) {
    using V = Vector<Real>;
    constexpr int lanes = VectorOf<Real>::lanes;
    for (int begin = 0; begin < width; begin += lanes)
        for (int p = 0; p < count; p += lanes) {
            V part[lanes];
            for (int q = 0; q < lanes; ++q) part[q] = *reinterpret_cast<const V*>(rows + (begin + q) * BLOCK + p);
            transpose<Real, 1>(part);
            const int some = std::min(lanes, count - p);
            for (int q = 0; q < some; ++q)
                *reinterpret_cast<V*>(records + std::int64_t(number[p + q]) * width + begin) += part[q];
        }
}

// Numbers of a record, so that it is a whole number of vectors.
template <typename Real>
constexpr int padded(int numbers) {
    constexpr int lanes = VectorOf<Real>::lanes;
    return (numbers + lanes - 1) / lanes * lanes;
}

}  // namespace eddies
