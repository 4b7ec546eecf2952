"""Arithmetic on blocks of 4 x 4 pixels: one Warp vector holds a number per pixel.

Warp has no element-wise comparison, and its ``min`` and ``max`` take three instructions for their rules on NaN; these
few functions are loops that a CPU compiler turns into one or two vector instructions each.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

import warp as wp

BLOCK = 4  # pixels: blocks are BLOCK x BLOCK
LANES = 16  # pixels of a block, row by row; and blocks of a tile


VECTORISED = {
    # Warp's loops over a vector's 16 numbers become one instruction each if they are not unrolled first, and if the
    # rest is not put together again from single numbers.
    "cpu_compiler_flags": "-march=native -mllvm=-inline-threshold=9000 -mllvm=-inline-cold-callsite-threshold=3000"
    " -mllvm=-unroll-full-max-count=8 -fno-slp-vectorize -ffp-contract=fast"
}
"""Module options of kernels that compute on lanes."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
""")
def lowest_bit(bits: int) -> int:  # type: ignore[empty-body]
    """Place of the lowest bit that is set; ``bits`` is not zero."""
    ...


@cache
def lanes_of(real: Any) -> Any:
    """The vector type that holds a number per pixel of a block."""
    return wp.types.vector(LANES, real)


@cache
def build(real: Any) -> SimpleNamespace:
    """Functions on lanes of one scalar type, ``wp.float32`` or ``wp.float64``."""
    lanes = lanes_of(real)
    integers = lanes_of(int)
    name = real.__name__

    @wp.func_native(f"""
    bool found = false;
    for (int i = 0; i < {LANES}; ++i) found |= x[i] > wp::{name}(0);
    return found;
    """)
    def any_positive(x: lanes) -> bool:  # type: ignore[valid-type, empty-body]
        """Whether a lane is above zero."""
        ...

    @wp.func_native(_positive_bits(name))
    def positive_bits(x: lanes) -> int:  # type: ignore[valid-type, empty-body]
        """Bit i is set where lane i is above zero."""
        ...

    @wp.func_native(f"""
    wp::vec_t<{LANES}, wp::{name}> out;
    for (int i = 0; i < {LANES}; ++i) {{
        const wp::{name} yes = a[i], no = b[i];
        out[i] = x[i] > y[i] ? yes : no;
    }}
    return out;
    """)
    def above(x: lanes, y: lanes, a: lanes, b: lanes) -> lanes:  # type: ignore[valid-type, empty-body]
        """``a`` in the lanes where x > y, else ``b``."""
        ...

    @wp.func_native(f"""
    wp::vec_t<{LANES}, wp::int32> out;
    for (int i = 0; i < {LANES}; ++i) {{
        const wp::int32 no = b[i];
        out[i] = x[i] > y[i] ? a : no;
    }}
    return out;
    """)
    def above_number(x: lanes, y: lanes, a: int, b: integers) -> integers:  # type: ignore[valid-type, empty-body]
        """``a`` in the lanes where x > y, else ``b``."""
        ...

    @wp.func_native(f"""
    wp::vec_t<{LANES}, wp::{name}> out;
    for (int i = 0; i < {LANES}; ++i) {{
        const wp::{name} x = a[i], y = b[i];
        out[i] = x < y ? x : y;
    }}
    return out;
    """)
    def lower(a: lanes, b: lanes) -> lanes:  # type: ignore[valid-type, empty-body]
        """The smaller of each two, ``b`` beside a NaN."""
        ...

    @wp.func_native(f"""
    wp::vec_t<{LANES}, wp::{name}> out;
    for (int i = 0; i < {LANES}; ++i) {{
        const wp::{name} x = a[i], y = b[i];
        out[i] = x > y ? x : y;
    }}
    return out;
    """)
    def higher(a: lanes, b: lanes) -> lanes:  # type: ignore[valid-type, empty-body]
        """The larger of each two, ``b`` beside a NaN."""
        ...

    @wp.func_native(_pairwise_sums(name))
    def sums(
        s0: lanes, s1: lanes, s2: lanes, s3: lanes, s4: lanes, s5: lanes, s6: lanes, s7: lanes,
        s8: lanes, s9: lanes, s10: lanes, s11: lanes, s12: lanes, s13: lanes, s14: lanes, s15: lanes,
    ) -> lanes:  # type: ignore[valid-type, empty-body]  # fmt: skip
        """The sum of each of 16 vectors, by halves: 15 additions of whole vectors."""
        ...

    # Warp's own indexing allows for negative indices and strides, some six instructions an access.
    @wp.func_native("return source.data[i];")
    def read(source: wp.array(dtype=lanes), i: int) -> lanes:  # type: ignore[valid-type, empty-body]
        """Element of a contiguous array, ``i >= 0``."""
        ...

    @wp.func_native("target.data[i] = value;")
    def write(target: wp.array(dtype=lanes), i: int, value: lanes):  # type: ignore[valid-type]
        """Set an element of a contiguous array, ``i >= 0``."""
        ...

    @wp.func_native("return source.data[i];")
    def number(source: wp.array(dtype=real), i: int) -> real:  # type: ignore[valid-type, empty-body]
        """Element of a contiguous array, ``i >= 0``."""
        ...

    @wp.func_native(f"""
    wp::vec_t<{LANES}, wp::{name}> out;
    for (int i = 0; i < {LANES}; ++i) out[i] = wp::sqrt(x[i]);
    return out;
    """)
    def roots(x: lanes) -> lanes:  # type: ignore[valid-type, empty-body]
        """Square root of each number."""
        ...

    @wp.func_native(_collect(name))
    def collect(
        source: wp.array(dtype=real), at: int, line: int, step: int, columns: int, rows: int
    ) -> lanes:  # type: ignore[valid-type, empty-body]
        """A block of a contiguous image: ``rows`` of ``columns`` pixels from element ``at``, pixels ``step`` and rows
        ``line`` elements apart; zero beyond."""
        ...

    @wp.func_native(f"""
    wp::vec_t<{LANES}, wp::{name}> out;
    for (int i = 0; i < {LANES}; ++i)
        out[i] = wp::{name}(i % {BLOCK} < columns && i / {BLOCK} < rows ? 1 : 0);
    return out;
    """)
    def inside(columns: int, rows: int) -> lanes:  # type: ignore[valid-type, empty-body]
        """One in the first ``rows`` of the first ``columns`` pixels of a block, zero beyond."""
        ...

    @wp.func_native(_spread(name))
    def spread(
        target: wp.array(dtype=real), at: int, line: int, step: int, columns: int, rows: int, values: lanes
    ):  # type: ignore[valid-type]
        """The inverse of ``collect``."""
        ...

    @wp.func_native(_spread("int32"))
    def spread_numbers(
        target: wp.array(dtype=int), at: int, line: int, step: int, columns: int, rows: int, values: integers
    ):  # type: ignore[valid-type]
        """As ``spread``."""
        ...

    return SimpleNamespace(
        above=above,
        above_number=above_number,
        any_positive=any_positive,
        collect=collect,
        higher=higher,
        inside=inside,
        lower=lower,
        number=number,
        positive_bits=positive_bits,
        read=read,
        roots=roots,
        spread=spread,
        spread_numbers=spread_numbers,
        sums=sums,
        write=write,
    )


def _vector(name: str) -> str:
    """C++ type ``lanes`` that is kept in registers whole: a CPU compiler's vector where there is one."""
    return f"""
#if defined(__clang__)
    typedef wp::{name} lanes __attribute__((vector_size({LANES} * sizeof(wp::{name})), aligned(4)));
#else
    typedef wp::vec_t<{LANES}, wp::{name}> lanes;
#endif
"""


def _positive_bits(name: str) -> str:
    """C++ that makes a bit of each comparison: one instruction where a CPU compiler has vectors of truths."""
    return f"""
#if defined(__clang__)
    typedef wp::{name} lanes __attribute__((vector_size({LANES} * sizeof(wp::{name})), aligned(4)));
    typedef bool truths __attribute__((ext_vector_type({LANES})));
    return __builtin_bit_cast(unsigned short, __builtin_convertvector(*(const lanes*)&x > 0, truths));
#else
    int bits = 0;
    for (int i = 0; i < {LANES}; ++i) bits |= x[i] > wp::{name}(0) ? 1 << i : 0;
    return bits;
#endif
    """


def _numbers(count: int, first: int = 0) -> str:
    return ", ".join(str(first + k) for k in range(count))


def _pixels(name: str, one: str, beside: str) -> str:
    """C++ for the pixels of a block that lie in the image: ``one`` for pixel ``c`` of row ``r``; ``beside`` for all of
    a whole block whose pixels lie side by side, where a CPU compiler has vectors of a row's ``quad``."""
    return f"""
    const bool whole = columns == {BLOCK} && rows == {BLOCK};
#if defined(__clang__)
    typedef wp::{name} quad __attribute__((vector_size({BLOCK} * sizeof(wp::{name})), aligned(4)));
    if (whole && step == 1) {{
        {beside}
    }} else
#endif
    if (whole) {{
        for (int r = 0; r < {BLOCK}; ++r)
            for (int c = 0; c < {BLOCK}; ++c) {one}
    }} else {{
        for (int r = 0; r < rows; ++r)
            for (int c = 0; c < columns; ++c) {one}
    }}
    """


def _spread(name: str) -> str:
    """C++ that writes a block to part of an image."""
    one = f"to[r * line + c * step] = x[r * {BLOCK} + c];"
    beside = " ".join(
        f"*(quad*)(to + {r} * line) = __builtin_shufflevector(x, x, {_numbers(BLOCK, BLOCK * r)});"
        for r in range(BLOCK)
    )
    return f"""{_vector(name)}
    const lanes x = *(const lanes*)&values;
    wp::{name}* to = target.data + at;
    {_pixels(name, one, beside)}
    """


def _collect(name: str) -> str:
    """C++ that reads part of an image as a block."""
    one = f"x[r * {BLOCK} + c] = from[r * line + c * step];"
    beside = f"""const quad a = *(const quad*)from, b = *(const quad*)(from + line);
        const quad c = *(const quad*)(from + 2 * line), d = *(const quad*)(from + 3 * line);
        x = __builtin_shufflevector(__builtin_shufflevector(a, b, {_numbers(2 * BLOCK)}),
                                    __builtin_shufflevector(c, d, {_numbers(2 * BLOCK)}), {_numbers(LANES)});"""
    return f"""{_vector(name)}
    lanes x = {{}};
    wp::vec_t<{LANES}, wp::{name}> out;
    const wp::{name}* from = source.data + at;
    {_pixels(name, one, beside)}
    *(lanes*)&out = x;
    return out;
    """


def _pairwise_sums(name: str) -> str:
    """C++ that adds up 16 vectors by halves: each step leaves half as many vectors, of twice as many sums."""
    steps, width, count = [], LANES // 2, LANES
    while count > 1:
        first = [k for k in range(2 * LANES) if k % (2 * width) < width]
        low = ", ".join(map(str, first))
        high = ", ".join(str(k + width) for k in first)
        steps += [
            f"x[{i}] = __builtin_shufflevector(x[{2 * i}], x[{2 * i + 1}], {low}) + "
            f"__builtin_shufflevector(x[{2 * i}], x[{2 * i + 1}], {high});"
            for i in range(count // 2)
        ]
        width, count = width // 2, count // 2
    inputs = [f"s{i}" for i in range(LANES)]
    return f"""
    wp::vec_t<{LANES}, wp::{name}> out;
#if defined(__clang__)
    typedef wp::{name} lanes __attribute__((vector_size({LANES} * sizeof(wp::{name})), aligned(4)));
    lanes x[{LANES}] = {{{", ".join(f"*(const lanes*)&{s}" for s in inputs)}}};
    {" ".join(steps)}
    *(lanes*)&out = x[0];
#else
    const wp::vec_t<{LANES}, wp::{name}> x[{LANES}] = {{{", ".join(inputs)}}};
    for (int i = 0; i < {LANES}; ++i) {{
        wp::{name} sum(0);
        for (int k = 0; k < {LANES}; ++k) sum += x[i][k];
        out[i] = sum;
    }}
#endif
    return out;
    """
