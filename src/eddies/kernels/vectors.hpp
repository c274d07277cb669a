// Data layouts: vectors of the processor, blocks of points, and the exchange between records (all numbers of a point)
// and rows (one number of all points of a block).

#pragma once

#include <algorithm>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <type_traits>

#if defined(__AVX512F__) || defined(__AVX2__)
#include <immintrin.h>
#endif

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

// Integers of the same size as the numbers.
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

template <typename Real>
struct VectorAnywhere {
    typedef Real type __attribute__((vector_size(VECTOR_BYTES), may_alias, aligned(sizeof(Real))));
};

// Load a vector from any address; the elements may be of another type of the same size.
template <typename Thing>
inline auto unaligned(const Thing* place) {
    using Real = std::conditional_t<sizeof(Thing) == 4, float, double>;
    return (Vector<Real>)*reinterpret_cast<const typename VectorAnywhere<Real>::type*>(place);
}

// Add to a vector at any address.
template <typename Real>
inline void add_unaligned(Real* place, Vector<Real> more) {
    *reinterpret_cast<typename VectorAnywhere<Real>::type*>(place) += more;
}

// The vector at an aligned address.
template <typename Real>
inline Vector<Real>& vector_at(Real* place) {
    return *reinterpret_cast<Vector<Real>*>(place);
}

template <typename Real>
inline const Vector<Real>& vector_at(const Real* place) {
    return *reinterpret_cast<const Vector<Real>*>(place);
}

// The numbers, limited to the range -largest ... largest. NaN stays NaN.
template <typename Real>
inline Vector<Real> clipped(Vector<Real> x, Real largest) {
    const Vector<Real> above = Vector<Real>{} + largest, below = -above;
#if defined(__AVX512F__)
    if constexpr (sizeof(Real) == 4) {
        const __m512 least = _mm512_maskz_min_ps(0xffff, (__m512)above, (__m512)x);
        return (Vector<Real>)_mm512_maskz_max_ps(0xffff, (__m512)below, least);
    } else {
        const __m512d least = _mm512_maskz_min_pd(0xff, (__m512d)above, (__m512d)x);
        return (Vector<Real>)_mm512_maskz_max_pd(0xff, (__m512d)below, least);
    }
#elif defined(__AVX2__)
    if constexpr (sizeof(Real) == 4)
        return (Vector<Real>)_mm256_max_ps((__m256)below, _mm256_min_ps((__m256)above, (__m256)x));
    else return (Vector<Real>)_mm256_max_pd((__m256d)below, _mm256_min_pd((__m256d)above, (__m256d)x));
#else
    x = above < x ? above : x;
    return below > x ? below : x;
#endif
}

// One bit for each lane of a mask, the first lane in the lowest bit.
template <typename Lanes>
inline std::uint64_t bits(Lanes lanes) {
    [[maybe_unused]] constexpr bool single = sizeof(lanes[0]) == 4;
#if defined(__AVX512F__)
    if constexpr (single) return _mm512_movepi32_mask((__m512i)lanes);
    return _mm512_movepi64_mask((__m512i)lanes);
#elif defined(__AVX2__)
    if constexpr (single) return _mm256_movemask_ps((__m256)lanes);
    return _mm256_movemask_pd((__m256d)lanes);
#else
    std::uint64_t mask = 0;
    for (int lane = 0; lane < int(sizeof(lanes) / sizeof(lanes[0])); ++lane) mask |= (lanes[lane] & 1ull) << lane;
    return mask;
#endif
}

// Write the numbers `begin`, `begin` + 1, ... whose bit is set, one after the other; up to a vector more is written.
inline void write_numbers(std::int32_t begin, std::uint64_t bits, std::int32_t* places) {
#ifdef __AVX512F__
    const __m512i lane = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
    for (; bits; bits >>= 16, begin += 16) {
        const auto mask = static_cast<__mmask16>(bits);
        _mm512_storeu_si512(places, _mm512_maskz_compress_epi32(mask, _mm512_add_epi32(lane, _mm512_set1_epi32(begin))));
        places += __builtin_popcount(mask);
    }
#else
    for (; bits; bits &= bits - 1) *places++ = begin + __builtin_ctzll(bits);
#endif
}

// Aligned numbers, initially zero.
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

// Rows of BLOCK numbers, one for each point of a block.
template <typename Real>
class Rows {
   public:
    explicit Rows(int rows) : numbers_(rows * BLOCK) {}
    Real* operator[](int row) { return numbers_.data() + row * BLOCK; }
    const Real* operator[](int row) const { return numbers_.data() + row * BLOCK; }

   private:
    Aligned<Real> numbers_;
};

// Group: the numbers of a record that are moved together.
template <typename Real>
constexpr int GROUP = 32 / sizeof(Real);

// Size of a record, rounded up to whole groups.
template <typename Real>
constexpr int padded(int numbers) {
    return (numbers + GROUP<Real> - 1) / GROUP<Real> * GROUP<Real>;
}

// A vector that holds some groups, one after the other.
template <typename Real>
inline Vector<Real> together(const Real* const* groups) {
#ifdef __AVX512F__
    const __m256i first = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(groups[0])),
                  second = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(groups[1]));
    return (Vector<Real>)_mm512_maskz_inserti64x4(0xff, _mm512_castsi256_si512(first), second, 1);
#else
    return *reinterpret_cast<const Vector<Real>*>(groups[0]);
#endif
}

// Add numbers to a group.
template <typename Real>
inline void add_to(Real* group, const Real* numbers) {
    typedef Real Group __attribute__((vector_size(32), may_alias, aligned(sizeof(Real))));
    *reinterpret_cast<Group*>(group) += *reinterpret_cast<const Group*>(numbers);
}

// Transpose groups in GROUP rows: row r and lane l of a group change places. One call exchanges lanes `stage` apart.
template <typename Real, int stage = 1>
inline void transpose(Vector<Real>* rows) {
    constexpr int lanes = VectorOf<Real>::lanes;
    if constexpr (stage < GROUP<Real>) {
        BitVector<Real> low, high;
        for (int lane = 0; lane < lanes; ++lane) {
            const bool second = lane & stage;
            low[lane] = second ? lanes + lane - stage : lane;
            high[lane] = second ? lanes + lane : lane + stage;
        }
        for (int row = 0; row < GROUP<Real>; ++row) {
            if (row & stage) continue;
            const Vector<Real> a = rows[row], b = rows[row + stage];
            rows[row] = __builtin_shuffle(a, b, low);
            rows[row + stage] = __builtin_shuffle(a, b, high);
        }
        transpose<Real, 2 * stage>(rows);
    }
}

// Gather the records (.., width) of numbered points as rows (width, BLOCK); the width is a whole number of groups.
// Inlining makes gradients over pairs a sixth slower without AVX.
template <typename Real>
__attribute__((noinline)) void gather(const Real* records, int width, const std::int32_t* number, Real* rows) {
    using V = Vector<Real>;
    constexpr int lanes = VectorOf<Real>::lanes, group = GROUP<Real>;
    for (int begin = 0; begin < width; begin += group)
        for (int p = 0; p < BLOCK; p += lanes) {
            V part[group];
            for (int q = 0; q < group; ++q) {
                const Real* groups[lanes / group];
                for (int g = 0; g < lanes / group; ++g)
                    groups[g] = records + std::int64_t(number[p + g * group + q]) * width + begin;
                part[q] = together(groups);
            }
            transpose<Real>(part);
            for (int q = 0; q < group; ++q) *reinterpret_cast<V*>(rows + (begin + q) * BLOCK + p) = part[q];
        }
}

// Add rows of the first `count` points of a block to their records.
template <typename Real>
inline void scatter_add(const Real* rows, int width, const std::int32_t* number, int count, Real* records) {
    using V = Vector<Real>;
    constexpr int lanes = VectorOf<Real>::lanes, group = GROUP<Real>;
    for (int begin = 0; begin < width; begin += group)
        for (int p = 0; p < count; p += lanes) {
            V part[group];
            for (int q = 0; q < group; ++q) part[q] = *reinterpret_cast<const V*>(rows + (begin + q) * BLOCK + p);
            transpose<Real>(part);
            const auto* numbers = reinterpret_cast<const Real*>(part);
            const int some = std::min(lanes, count - p);
            for (int q = 0; q < some; ++q)
                add_to(records + std::int64_t(number[p + q]) * width + begin,
                       numbers + q % group * lanes + q / group * group);
        }
}

}  // namespace eddies
