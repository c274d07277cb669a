// Reverse-mode differentiation of formulas of vectors. Each formula is written once: with plain vectors as arguments it
// is evaluated, with `Place`s as arguments it is differentiated.
//
// `let` stores an intermediate result. An expression holds its places by reference and its parts by value. `back` takes
// the gradient with respect to the expression and adds its share to the gradients with respect to the places. A stored
// result passes its gradient on when it is destroyed. C++ destroys in the reverse order of construction, which is the
// order of the chain rule. A stored result must outlive all expressions that use it.

#pragma once

#include <type_traits>

#include "vectors.hpp"

namespace eddies {

// A node of the formula: it has a `value` and a method `back`.
template <typename Real>
struct Node {
    using Number = Real;
};

template <typename A, typename = void>
constexpr bool is_node = false;

template <typename A>
constexpr bool is_node<A, std::void_t<typename A::Number>> = true;

// A constant, without a gradient.
template <typename Real>
struct Constant : Node<Real> {
    Vector<Real> value;
    Constant() = default;
    Constant(Vector<Real> value) : value(value) {}
    void back(Vector<Real>) const {}
};

// A variable, and the gradient with respect to it, which is zero at first.
template <typename Real>
struct Place : Node<Real> {
    Vector<Real> value;
    mutable Vector<Real> by{};
    Place() = default;
    Place(Vector<Real> value) : value(value) {}
    void back(Vector<Real> more) const { by += more; }
};

template <typename A>
using Held = std::conditional_t<std::is_base_of_v<Place<typename A::Number>, A>, const A&, const A>;

// A function of two nodes, with its partial derivatives.
template <typename A, typename B>
struct Made : Node<typename A::Number> {
    using V = Vector<typename A::Number>;
    Held<A> a;
    Held<B> b;
    V value, by_a, by_b;

    Made(const A& a, const B& b, V value, V by_a, V by_b) : a(a), b(b), value(value), by_a(by_a), by_b(by_b) {}
    void back(V by) const {
        a.back(by * by_a);
        b.back(by * by_b);
    }
};

template <typename A>
struct Named : Place<typename A::Number> {
    const A made;
    explicit Named(const A& made) : Place<typename A::Number>(made.value), made(made) {}
    Named(const Named&) = delete;
    ~Named() { made.back(this->by); }
};

// Store an intermediate result.
template <typename A>
inline auto let(const A& made) {
    if constexpr (is_node<A>) return Named<A>(made);
    else return made;
}

template <typename A>
inline const auto& value_of(const A& a) {
    if constexpr (is_node<A>) return a.value;
    else return a;
}

// The number type of two operands, at least one of which is a node.
template <typename A, typename B>
using NumberOf = typename std::conditional_t<is_node<A>, A, B>::Number;

// An operand as a node: a number or a vector becomes a constant.
template <typename Real, typename A>
inline decltype(auto) lifted(const A& a) {
    if constexpr (is_node<A>) return (a);
    else return Constant<Real>(Vector<Real>{} + a);
}

template <typename A, typename B, typename V>
inline auto made(const A& a, const B& b, V value, V by_a, V by_b) {
    return Made<A, B>(a, b, value, by_a, by_b);
}

#define EDDIES_OPERATOR(NAME, VALUE, BY_A, BY_B)                                                \
    template <typename A, typename B, typename = std::enable_if_t<is_node<A> || is_node<B>>>    \
    inline auto NAME(const A& one, const B& other) {                                            \
        using Real = NumberOf<A, B>;                                                            \
        using V = Vector<Real>;                                                                 \
        const auto &a = lifted<Real>(one), &b = lifted<Real>(other);                            \
        const V x = a.value, y = b.value;                                                       \
        return made(a, b, V(VALUE), V(BY_A), V(BY_B));                                          \
    }

EDDIES_OPERATOR(operator+, x + y, V{} + Real(1), V{} + Real(1))
EDDIES_OPERATOR(operator-, x - y, V{} + Real(1), V{} - Real(1))
EDDIES_OPERATOR(operator*, x* y, y, x)
EDDIES_OPERATOR(operator/, x / y, Real(1) / y, -x / (y * y))

#undef EDDIES_OPERATOR

// The same number in each lane.
template <typename A, typename Vector>
inline auto spread(const A& a, const Vector&) {
    if constexpr (std::is_arithmetic_v<A>) return Vector{} + a;
    else return a;
}

// `a` where the mask is set, else `b`, lane by lane.
template <typename Mask, typename A, typename B>
inline auto where(Mask mask, const A& a, const B& b) {
    if constexpr (is_node<A> || is_node<B>) {
        using Real = NumberOf<A, B>;
        const auto &one = lifted<Real>(a), &other = lifted<Real>(b);
        const Vector<Real> first = mask ? Vector<Real>{} + Real(1) : Vector<Real>{};
        const Vector<Real> value = mask ? one.value : other.value, second = Real(1) - first;
        return made(one, other, value, first, second);
    } else {
        return mask ? spread(a, b) : spread(b, a);
    }
}

// Minimum of a node and a constant limit.
template <typename Real, typename A>
inline auto at_most(const A& a, Real limit) {
    return where(value_of(a) < limit, a, limit);
}

// Scalar product of two vectors in space.
template <typename A, typename B>
inline auto product(const A (&a)[3], const B (&b)[3]) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

}  // namespace eddies
