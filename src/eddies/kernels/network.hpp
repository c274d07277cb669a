// A fully connected network with tanh layers for a block of points at once: outputs, and gradients that go back through
// it. Features and outputs are rows of a block, a number for each point.

#pragma once

#include <cstddef>
#include <stdexcept>
#include <type_traits>
#include <vector>

#include "vectors.hpp"

namespace eddies {

// A power series in `x`, the constant coefficient first.
template <typename V, typename Real, std::size_t terms>
inline V series(const Real (&coefficients)[terms], V x) {
    V sum = V{} + coefficients[terms - 1];
#pragma GCC unroll 16
    for (int k = static_cast<int>(terms) - 2; k >= 0; --k) sum = sum * x + coefficients[k];
    return sum;
}

// Factor by which the arguments of tanh are multiplied before `tanh_of`.
template <typename Real>
constexpr double TANH_UNIT = 1.0;

// Vectors that `tanh_of` processes together, so that one does not wait for the result of each step.
constexpr int TOGETHER = 4;

// tanh(x) as y P(y^2) / Q(y^2) with y = x TANH_UNIT. This is a minimax fit for |x| <= 8; beyond, the value at 8 is
// taken. Its error is 4e-7, or 6e-7 with round-off. In the unit TANH_UNIT the highest coefficients of P and Q are 1,
// which saves two products. Two vectors share a division, and so NaN in a lane of one becomes NaN in the other.
template <>
constexpr double TANH_UNIT<float> = 0.021518350198783773;

inline void tanh_of(float* numbers) {
    using V = Vector<float>;
    constexpr float above[] = {8.68697404e-6f, 2.42495333e-3f, 1.19565258e-1f};
    constexpr float below[] = {1.86929377e-7f, 1.86747455e-4f, 2.07635762e-2f, 4.49385810e-1f};
    V* place = reinterpret_cast<V*>(numbers);
    V x[TOGETHER], square[TOGETHER], upper[TOGETHER], lower[TOGETHER];
    for (int v = 0; v < TOGETHER; ++v) x[v] = clipped(place[v], static_cast<float>(8 * TANH_UNIT<float>));
    for (int v = 0; v < TOGETHER; ++v) square[v] = x[v] * x[v];
    for (int v = 0; v < TOGETHER; ++v) upper[v] = square[v] + above[2];
    for (int v = 0; v < TOGETHER; ++v) lower[v] = square[v] + below[3];
#pragma GCC unroll 4
    for (int k = 2; k >= 0; --k) {
        for (int v = 0; v < TOGETHER; ++v) lower[v] = lower[v] * square[v] + below[k];
        for (int v = 0; v < TOGETHER; ++v) upper[v] = k > 0 ? upper[v] * square[v] + above[k - 1] : upper[v] * x[v];
    }
    for (int v = 0; v < TOGETHER; v += 2) {
        const V inverse = 1.0f / (lower[v] * lower[v + 1]);
        place[v] = upper[v] * (lower[v + 1] * inverse);
        place[v + 1] = upper[v + 1] * (lower[v] * inverse);
    }
}

// 1 - 2 / (exp(2 x) + 1); exp(a) = 2^n exp(r), a = n log 2 + r, by the series of exp(r).
inline Vector<double> tanh_of(Vector<double> x) {
    using V = Vector<double>;
    constexpr double round = 6755399441055744.0;  // adding it rounds to an integer
    constexpr double inverse_factorial[] = {1.0, 1.0, 1.0 / 2, 1.0 / 6, 1.0 / 24, 1.0 / 120, 1.0 / 720, 1.0 / 5040,
                                            1.0 / 40320, 1.0 / 362880, 1.0 / 3628800, 1.0 / 39916800,
                                            1.0 / 479001600, 1.0 / 6227020800};
    x = clipped(x, 20.0);
    const V a = x + x, shifted = a * 1.4426950408889634 + round, whole = shifted - round;
    const V r = (a - whole * 0.693145751953125) - whole * 1.42860682030941723212e-6;  // log 2 in two parts
    const auto bits = (BitVector<double>)series(inverse_factorial, r) + ((BitVector<double>)shifted << 52);
    return 1.0 - 2.0 / ((V)bits + 1.0);  // the exponent's bits begin at 52: times 2^n
}

inline void tanh_of(double* numbers) {
    for (int v = 0; v < TOGETHER; ++v) {
        auto& place = vector_at(numbers + v * VectorOf<double>::lanes);
        place = tanh_of(place);
    }
}

// A layer processes a tile of points at a time, so that what it reads stays in the first-level cache. It takes a group
// of rows of its weights at a time, so that the sums stay in registers.
#if defined(__AVX512F__)
constexpr int TILE_VECTORS = 4, MOST_ROWS = 6;
#elif defined(__AVX2__)
constexpr int TILE_VECTORS = 2, MOST_ROWS = 6;
#else
constexpr int TILE_VECTORS = 1, MOST_ROWS = 4;
#endif

template <typename Real>
constexpr int TILE = TILE_VECTORS * VectorOf<Real>::lanes;

// Call `use` with a size that the compiler knows.
template <int most, typename Use>
inline void with_size(int size, const Use& use) {
    if constexpr (most > 1)
        if (size < most) return with_size<most - 1>(size, use);
    use(std::integral_constant<int, most>());
}

// Divide `count` members into about equally large groups of at most `most` members. Call `use` with the size and the
// first member of each group.
template <int most, typename Use>
inline void in_groups(int count, const Use& use) {
    int first = 0;
    for (int left = (count + most - 1) / most; left > 0; --left) {
        const int size = (count - first + left - 1) / left;
        with_size<most>(size, [&](auto known) { use(known, first); });
        first += size;
    }
}

// Rows of a tile, with the distance between them.
template <typename Real>
struct TileRows {
    Real* first;
    int apart;
    Real* operator[](int row) const { return first + row * apart; }
    operator TileRows<const Real>() const { return {first, apart}; }
};

// A matrix (outputs, inputs), stored by groups of rows: of each group the first column, then the second, and so on.
template <typename Real>
class Matrix {
   public:
    template <typename At>
    Matrix(int outputs, int inputs, const At& at) : outputs_(outputs), inputs_(inputs) {
        in_groups<MOST_ROWS>(outputs, [&](auto rows, int first) {
            for (int i = 0; i < inputs; ++i)
                for (int row = 0; row < rows; ++row) numbers_.push_back(static_cast<Real>(at(first + row, i)));
        });
    }

    // Product with the rows of a tile, plus biases unless these are null.
    void multiply(const Real* biases, TileRows<const Real> given, TileRows<Real> result) const {
        in_groups<MOST_ROWS>(outputs_, [&](auto rows, int first) {
            multiply_rows<rows>(numbers_.data() + first * inputs_, biases ? biases + first : nullptr, given,
                                {result[first], result.apart});
        });
    }

   private:
    int outputs_, inputs_;
    std::vector<Real> numbers_;

    template <int rows>
    void multiply_rows(const Real* weights, const Real* biases, TileRows<const Real> given,
                       TileRows<Real> result) const {
        using V = Vector<Real>;
        constexpr int lanes = VectorOf<Real>::lanes;
        V sums[rows][TILE_VECTORS];
#pragma GCC unroll 8
        for (int row = 0; row < rows; ++row)
#pragma GCC unroll 4
            for (int v = 0; v < TILE_VECTORS; ++v) sums[row][v] = V{} + (biases ? biases[row] : Real(0));
        const Real* place = given.first;
#pragma GCC unroll 4
        for (int i = 0; i < inputs_; ++i, place += given.apart, weights += rows) {
#pragma GCC unroll 8
            for (int row = 0; row < rows; ++row)
#pragma GCC unroll 4
                for (int v = 0; v < TILE_VECTORS; ++v) sums[row][v] += weights[row] * vector_at(place + v * lanes);
        }
#pragma GCC unroll 8
        for (int row = 0; row < rows; ++row)
#pragma GCC unroll 4
            for (int v = 0; v < TILE_VECTORS; ++v) vector_at(result[row] + v * lanes) = sums[row][v];
    }
};

// The network. Its parameters, and the gradients with respect to them, are in order of the layers: of each layer the
// weights (outputs, inputs), then the biases (outputs).
template <typename Real>
class Network {
   public:
    // Throws std::invalid_argument if the number of parameters is wrong.
    Network(std::vector<int> widths, const double* parameters, std::int64_t count) : widths_(std::move(widths)) {
        for (int layer = 0; layer < layers(); ++layer) count -= (widths_[layer] + 1) * widths_[layer + 1];
        if (count != 0) throw std::invalid_argument("parameters of a network");
        for (int layer = 0; layer < layers(); ++layer) {
            const int inputs = widths_[layer], outputs = widths_[layer + 1];
            const double unit = layer + 1 < layers() ? TANH_UNIT<Real> : 1.0;
            forth_.emplace_back(outputs, inputs, [&](int o, int i) { return unit * parameters[o * inputs + i]; });
            back_.emplace_back(inputs, outputs, [&](int i, int o) { return parameters[o * inputs + i]; });
            parameters += inputs * outputs;
            biases_.emplace_back(outputs);
            for (Real& bias : biases_.back()) bias = static_cast<Real>(unit * *parameters++);
        }
        for (const int width : widths_) {
            values_.emplace_back(held(width));
            deltas_.emplace_back(held(width));
        }
    }

    // Memory of the features of the points, and of the gradient with respect to them.
    Rows<Real>& features() { return values_.front(); }
    const Rows<Real>& by_features() const { return deltas_.front(); }
    // The same for the outputs.
    const Rows<Real>& outputs() const { return values_.back(); }
    Rows<Real>& by_outputs() { return deltas_.back(); }

    void forward() {
        for (int p = 0; p < BLOCK; p += TILE<Real>)
            for (int layer = 0; layer < layers(); ++layer) {
                const TileRows<Real> result = tile(values_, layer + 1, p);
                forth_[layer].multiply(biases_[layer].data(), tile(values_, layer, p), result);
                if (layer + 1 == layers()) break;
                const int count = held(widths_[layer + 1]) * TILE<Real>;
                for (int q = 0; q < count; q += TOGETHER * VectorOf<Real>::lanes) tanh_of(result.first + q);
            }
    }

    // After `forward`: from the gradients with respect to the outputs, add those with respect to the parameters, a
    // vector for each parameter, and find those with respect to the features if `features_too`.
    void backward(Real* by_parameters, bool features_too) {
        constexpr int lanes = VectorOf<Real>::lanes;
        for (int layer = 0; layer < layers(); ++layer)
            by_parameters += lanes * (widths_[layer] + 1) * widths_[layer + 1];
        for (int layer = layers() - 1; layer >= 0; --layer) {
            by_parameters -= lanes * (widths_[layer] + 1) * widths_[layer + 1];
            add_by_parameters(layer, by_parameters);
            if (layer == 0 && !features_too) return;
            for (int p = 0; p < BLOCK; p += TILE<Real>) {
                const TileRows<Real> before = tile(deltas_, layer, p);
                back_[layer].multiply(nullptr, tile(deltas_, layer + 1, p), before);
                if (layer == 0) continue;
                const Real* value = tile(values_, layer, p)[0];
#pragma omp simd
                for (int q = 0; q < widths_[layer] * TILE<Real>; ++q) before.first[q] *= 1 - value[q] * value[q];
            }
        }
    }

   private:
    std::vector<int> widths_;
    std::vector<Matrix<Real>> forth_, back_;  // back: (inputs, outputs)
    std::vector<std::vector<Real>> biases_;
    std::vector<Rows<Real>> values_, deltas_;  // those of hidden layers are tile by tile

    int layers() const { return static_cast<int>(widths_.size()) - 1; }

    // Number of rows of a tile, rounded up for tanh; rows beyond the width stay zero.
    static int held(int width) { return (width + TOGETHER - 1) / TOGETHER * TOGETHER; }

    // Rows of a block; `apart` is the distance between rows, `next` that between tiles.
    struct BlockRows {
        const Real* first;
        std::ptrdiff_t apart, next;
        BlockRows from(int row) const { return {first + row * apart, apart, next}; }
    };

    BlockRows block(std::vector<Rows<Real>>& rows, int layer) const {
        const TileRows<Real> first = tile(rows, layer, 0);
        return {first.first, first.apart, tile(rows, layer, TILE<Real>).first - first.first};
    }

    // The rows of the tile whose first point is `p`.
    TileRows<Real> tile(std::vector<Rows<Real>>& rows, int layer, int p) const {
        if (layer == 0 || layer == layers()) return {rows[layer][0] + p, BLOCK};
        return {rows[layer][0] + p * held(widths_[layer]), TILE<Real>};
    }

    // Add the contribution of a block to the gradient with respect to the weights and biases of a layer.
    void add_by_parameters(int layer, Real* by_parameters) {
        constexpr int lanes = VectorOf<Real>::lanes;
        const int inputs = widths_[layer], outputs = widths_[layer + 1];
        const BlockRows deltas = block(deltas_, layer + 1), given = block(values_, layer);
        in_groups<2>(outputs, [&](auto rows, int output) {
            in_groups<4>(inputs, [&](auto columns, int input) {
                add_products<rows, columns>(deltas.from(output), given.from(input), inputs,
                                            by_parameters + (output * inputs + input) * lanes);
            });
        });
        by_parameters += inputs * outputs * lanes;
        for (int o = 0; o < outputs; ++o) {
            Vector<Real> sum = vector_at(by_parameters + o * lanes);
            for (int p = 0; p < BLOCK; p += lanes)
                sum += vector_at(deltas.from(o).first + p / TILE<Real> * deltas.next + p % TILE<Real>);
            vector_at(by_parameters + o * lanes) = sum;
        }
    }

    // The same for the weights of some outputs and some inputs. The weights of the next output are `inputs` further on.
    template <int rows, int columns>
    static void add_products(BlockRows deltas, BlockRows given, int inputs, Real* by_weights) {
        using V = Vector<Real>;
        constexpr int lanes = VectorOf<Real>::lanes;
        V sums[rows][columns];
        for (int row = 0; row < rows; ++row)
            for (int i = 0; i < columns; ++i) sums[row][i] = vector_at(by_weights + (row * inputs + i) * lanes);
        for (int p = 0; p < BLOCK; p += TILE<Real>, deltas.first += deltas.next, given.first += given.next)
#pragma GCC unroll 4
            for (int q = 0; q < TILE<Real>; q += lanes)
#pragma GCC unroll 2
                for (int row = 0; row < rows; ++row) {
                    const V delta = vector_at(deltas.first + row * deltas.apart + q);
#pragma GCC unroll 4
                    for (int i = 0; i < columns; ++i)
                        sums[row][i] += delta * vector_at(given.first + i * given.apart + q);
                }
        for (int row = 0; row < rows; ++row)
            for (int i = 0; i < columns; ++i) vector_at(by_weights + (row * inputs + i) * lanes) = sums[row][i];
    }
};

}  // namespace eddies
