// Smoothing kernels W(r) of compact support, as polynomials in each of equally long pieces of 0 <= r < h.

#pragma once

#include <cstdint>
#include <vector>

namespace eddies {

template <typename Real>
class Smoothing {
   public:
    // h, number of pieces, coefficients of each; then these, of u = 1 ... 0 from begin to end of a piece.
    explicit Smoothing(const double* given)
        : pieces_(static_cast<int>(given[1])), width_(static_cast<int>(given[2])),
          per_length_(static_cast<Real>(given[1] / given[0])),
          coefficients_(given + 3, given + 3 + pieces_ * width_) {}

    Real value(Real distance) const {
        Real u;
        const Real* c = locate(distance, u);
        Real sum = c[width_ - 1];
        for (int k = width_ - 2; k >= 0; --k) sum = sum * u + c[k];
        return sum > 0 ? sum : Real(0);  // below zero by rounding alone
    }

    // dW/dr.
    Real slope(Real distance) const {
        Real u;
        const Real* c = locate(distance, u);
        Real sum = (width_ - 1) * c[width_ - 1];
        for (int k = width_ - 2; k >= 1; --k) sum = sum * u + k * c[k];
        return -sum * per_length_;
    }

   private:
    int pieces_, width_;
    Real per_length_;
    std::vector<Real> coefficients_;

    const Real* locate(Real distance, Real& u) const {
        const Real place = distance * per_length_;
        const int piece = static_cast<int>(place), last = pieces_ - 1, kept = piece < last ? piece : last;
        u = static_cast<Real>(kept + 1) - place;
        return &coefficients_[kept * width_];
    }
};

}  // namespace eddies
