// Smoothing kernels W(r) of compact support, given by a polynomial in each of equally long pieces of 0 <= r < h.

#pragma once

#include <algorithm>
#include <cstdint>

#include "vectors.hpp"

namespace eddies {

template <typename Real>
class Smoothing {
    using V = Vector<Real>;

   public:
    // `given` holds h, the least value of W, the number of pieces and the number of coefficients of a piece. Then come
    // the coefficients of each piece. They belong to the powers of u, which falls from 1 to 0 along the piece.
    explicit Smoothing(const double* given)
        : pieces_(static_cast<int>(given[2])), width_(static_cast<int>(given[3])), stride_(padded<Real>(width_)),
          least_(static_cast<Real>(given[1])), per_length_(static_cast<Real>(given[2] / given[0])),
          coefficients_(std::size_t(pieces_) * stride_) {
        for (int piece = 0; piece < pieces_; ++piece)
            std::copy_n(given + 4 + piece * width_, width_, coefficients_.data() + piece * stride_);
    }

    // W at distances below h; any finite value at others.
    V value(V distance) const {
        V slope;
        return evaluated<false>(distance, slope);
    }

    // The same, and dW/dr.
    V value(V distance, V& slope) const { return evaluated<true>(distance, slope); }

   private:
    int pieces_, width_, stride_;
    Real least_, per_length_;
    Aligned<Real> coefficients_;  // of each piece, and zeros up to a whole number of groups

    template <bool sloping>
    V evaluated(V distance, V& slope) const {
        constexpr int lanes = VectorOf<Real>::lanes, group = GROUP<Real>;
        const V place = distance * per_length_;
        BitVector<Real> piece = __builtin_convertvector(place, BitVector<Real>);
        piece = piece < pieces_ - 1 ? piece : pieces_ - 1 - BitVector<Real>{};
        const V u = __builtin_convertvector(piece + 1, V) - place;
        V sum{}, rate{};
        for (int begin = stride_ - group; begin >= 0; begin -= group) {
            V part[group];
            for (int q = 0; q < group; ++q) {
                const Real* groups[lanes / group];
                for (int g = 0; g < lanes / group; ++g)
                    groups[g] = coefficients_.data() + piece[g * group + q] * stride_ + begin;
                part[q] = together(groups);
            }
            transpose<Real>(part);
            for (int k = group - 1; k >= 0; --k) {  // Horner, and its derivative
                if (sloping) rate = rate * u + sum;
                sum = sum * u + part[k];
            }
        }
        if (sloping) slope = -rate * per_length_;
        return sum > least_ ? sum : V{} + least_;  // values below the least are rounding errors
    }
};

}  // namespace eddies
