// A fully connected network with tanh layers for a block of points at once: outputs, and gradients that go back through
// it. Features and outputs are rows of a block, a number for each point.

#pragma once

#include <cstddef>
#include <stdexcept>
#include <vector>

#include "vectors.hpp"

namespace eddies {

// A power series in `x`, its first coefficient first.
template <typename V, typename Real, std::size_t terms>
inline V series(const Real (&coefficients)[terms], V x) {
    V sum = V{} + coefficients[terms - 1];
#pragma GCC unroll 16
    for (int k = static_cast<int>(terms) - 2; k >= 0; --k) sum = sum * x + coefficients[k];
    return sum;
}

template <typename V, typename Real>
inline V clipped(V x, Real largest) {
    x = x > largest ? V{} + largest : x;
    return x < -largest ? V{} - largest : x;
}

// x P(x^2) / Q(x^2), to 7e-9 of tanh up to 8, a minimax fit, and beyond as there, where 2e-7 are missing to 1.
inline Vector<float> tanh_of(Vector<float> x) {
    constexpr float upper[] = {1.0f, 1.34468052e-1f, 3.57432509e-3f, 2.19393224e-5f, 1.52927450e-8f};
    constexpr float lower[] = {1.0f, 4.67801345e-1f, 2.61748484e-2f, 3.41573804e-4f, 8.54780856e-7f};
    x = clipped(x, 8.0f);
    const Vector<float> square = x * x;
    return x * series(upper, square) / series(lower, square);
}

// 1 - 2 / (exp(2 x) + 1); exp(a) = 2^n exp(r), a = n log 2 + r, by the series of exp(r).
inline Vector<double> tanh_of(Vector<double> x) {
    using V = Vector<double>;
    constexpr double round = 6755399441055744.0;  // next to which numbers are whole
    constexpr double inverse_factorial[] = {1.0, 1.0, 1.0 / 2, 1.0 / 6, 1.0 / 24, 1.0 / 120, 1.0 / 720, 1.0 / 5040,
                                            1.0 / 40320, 1.0 / 362880, 1.0 / 3628800, 1.0 / 39916800,
                                            1.0 / 479001600, 1.0 / 6227020800};
    x = clipped(x, 20.0);
    const V a = x + x, shifted = a * 1.4426950408889634 + round, whole = shifted - round;
    const V r = (a - whole * 0.693145751953125) - whole * 1.42860682030941723212e-6;  // log 2 in two parts
    const auto bits = (BitVector<double>)series(inverse_factorial, r) + ((BitVector<double>)shifted << 52);
    return 1.0 - 2.0 / ((V)bits + 1.0);  // the exponent's bits begin at 52: times 2^n
}

// Adds numbers of a block to a vector.
template <typename Real>
inline void add_lanes(const Real* numbers, Real* lanes) {
    auto* sum = reinterpret_cast<Vector<Real>*>(lanes);
    for (int p = 0; p < BLOCK; p += VectorOf<Real>::lanes) *sum += *reinterpret_cast<const Vector<Real>*>(numbers + p);
}

// `outputs` rows of weights (outputs, inputs) times rows, added to biases.
template <int outputs, typename Real>
inline void multiply_rows(int inputs, const Real* weights, const Real* biases, const Real* given, Real* result) {
    using V = Vector<Real>;
    constexpr int lanes = VectorOf<Real>::lanes;
    for (int p = 0; p < BLOCK; p += 2 * lanes) {
        V sums[outputs][2];
        for (int o = 0; o < outputs; ++o) sums[o][0] = sums[o][1] = V{} + (biases ? biases[o] : Real(0));
        for (int i = 0; i < inputs; ++i) {
            const V* points = reinterpret_cast<const V*>(given + i * BLOCK + p);
            for (int o = 0; o < outputs; ++o) {
                const Real weight = weights[o * inputs + i];
                sums[o][0] += weight * points[0];
                sums[o][1] += weight * points[1];
            }
        }
        for (int o = 0; o < outputs; ++o) {
            V* place = reinterpret_cast<V*>(result + o * BLOCK + p);
            place[0] = sums[o][0];
            place[1] = sums[o][1];
        }
    }
}

template <typename Real>
void multiply(int outputs, int inputs, const Real* weights, const Real* biases, const Real* given, Real* result) {
    int o = 0;
    for (; o + 4 <= outputs; o += 4)
        multiply_rows<4>(inputs, weights + o * inputs, biases ? biases + o : nullptr, given, result + o * BLOCK);
    for (; o + 2 <= outputs; o += 2)
        multiply_rows<2>(inputs, weights + o * inputs, biases ? biases + o : nullptr, given, result + o * BLOCK);
    for (; o < outputs; ++o)
        multiply_rows<1>(inputs, weights + o * inputs, biases ? biases + o : nullptr, given, result + o * BLOCK);
}

// Adds what a block's points give to the gradient by weights, a vector for each: `outputs` times `inputs` of them, in
// rows of `stride`.
template <int outputs, int inputs, typename Real>
inline void add_products(int stride, const Real* delta, const Real* given, Real* lanes) {
    using V = Vector<Real>;
    V* sums = reinterpret_cast<V*>(lanes);
    V found[outputs][inputs];
    for (int o = 0; o < outputs; ++o)
        for (int i = 0; i < inputs; ++i) found[o][i] = sums[o * stride + i];
    for (int p = 0; p < BLOCK; p += VectorOf<Real>::lanes)
        for (int o = 0; o < outputs; ++o) {
            const V d = *reinterpret_cast<const V*>(delta + o * BLOCK + p);
            for (int i = 0; i < inputs; ++i)
                found[o][i] += d * *reinterpret_cast<const V*>(given + i * BLOCK + p);
        }
    for (int o = 0; o < outputs; ++o)
        for (int i = 0; i < inputs; ++i) sums[o * stride + i] = found[o][i];
}

template <int outputs, typename Real>
inline void add_rows_of_products(int inputs, const Real* delta, const Real* given, Real* sums) {
    constexpr int lanes = VectorOf<Real>::lanes;
    int i = 0;
    for (; i + 4 <= inputs; i += 4) add_products<outputs, 4>(inputs, delta, given + i * BLOCK, sums + i * lanes);
    for (; i < inputs; ++i) add_products<outputs, 1>(inputs, delta, given + i * BLOCK, sums + i * lanes);
}

// The network; its parameters, as given and as gradients, are the weights (outputs, inputs) and biases (outputs) of one
// layer after the other.
template <typename Real>
class Network {
   public:
    // Throws std::invalid_argument where the count is another than that of the parameters.
    Network(std::vector<int> widths, const double* parameters, std::int64_t count) : widths_(std::move(widths)) {
        for (int layer = 0; layer < layers(); ++layer) count -= (widths_[layer] + 1) * widths_[layer + 1];
        if (count != 0) throw std::invalid_argument("parameters of a network");
        for (int layer = 0; layer < layers(); ++layer) {
            const int inputs = widths_[layer], outputs = widths_[layer + 1];
            weights_.emplace_back(parameters, parameters + inputs * outputs);
            parameters += inputs * outputs;
            biases_.emplace_back(parameters, parameters + outputs);
            parameters += outputs;
            std::vector<Real> turned(inputs * outputs);
            for (int o = 0; o < outputs; ++o)
                for (int i = 0; i < inputs; ++i) turned[i * outputs + o] = weights_[layer][o * inputs + i];
            turned_.push_back(std::move(turned));
        }
        for (const int width : widths_) {
            values_.emplace_back(width);
            deltas_.emplace_back(width);
        }
    }

    // Where the features of the points are expected, and where the gradient by them is found.
    Rows<Real>& features() { return values_.front(); }
    const Rows<Real>& by_features() const { return deltas_.front(); }
    // Likewise of the outputs.
    const Rows<Real>& outputs() const { return values_.back(); }
    Rows<Real>& by_outputs() { return deltas_.back(); }

    void forward() {
        for (int layer = 0; layer < layers(); ++layer) {
            const int inputs = widths_[layer], outputs = widths_[layer + 1];
            Real* result = values_[layer + 1][0];
            multiply(outputs, inputs, weights_[layer].data(), biases_[layer].data(), values_[layer][0], result);
            if (layer + 1 == layers()) return;
            for (int p = 0; p < outputs * BLOCK; p += VectorOf<Real>::lanes) {
                auto* place = reinterpret_cast<Vector<Real>*>(result + p);
                *place = tanh_of(*place);
            }
        }
    }

    // After `forward`: from the gradient by outputs those by parameters, added to a vector for each, and by features.
    void backward(Real* by_parameters, bool features_too) {
        constexpr int lanes = VectorOf<Real>::lanes;
        for (int layer = 0; layer < layers(); ++layer)
            by_parameters += lanes * (widths_[layer] + 1) * widths_[layer + 1];
        for (int layer = layers() - 1; layer >= 0; --layer) {
            const int inputs = widths_[layer], outputs = widths_[layer + 1];
            const Real *delta = deltas_[layer + 1][0], *given = values_[layer][0];
            by_parameters -= lanes * (inputs + 1) * outputs;
            int o = 0;
            for (; o + 2 <= outputs; o += 2)
                add_rows_of_products<2>(inputs, delta + o * BLOCK, given, by_parameters + o * inputs * lanes);
            for (; o < outputs; ++o)
                add_rows_of_products<1>(inputs, delta + o * BLOCK, given, by_parameters + o * inputs * lanes);
            for (o = 0; o < outputs; ++o) add_lanes(delta + o * BLOCK, by_parameters + (inputs * outputs + o) * lanes);
            if (layer == 0 && !features_too) return;
            Real* before = deltas_[layer][0];
            multiply<Real>(inputs, outputs, turned_[layer].data(), nullptr, delta, before);
            if (layer > 0)
#pragma omp simd
                for (int p = 0; p < inputs * BLOCK; ++p) before[p] *= 1 - given[p] * given[p];
        }
    }

   private:
    std::vector<int> widths_;
    std::vector<std::vector<Real>> weights_, turned_, biases_;  // turned: (inputs, outputs)
    std::vector<Rows<Real>> values_, deltas_;

    int layers() const { return static_cast<int>(widths_.size()) - 1; }
};

}  // namespace eddies
