"""The tool that runs CUDA kernels on a CPU: instructions against known answers, scheduling, and what it finds out."""

import ctypes
import math
import struct

import numpy as np
import ptx
import pytest
import warp as wp

ENTRY = """
.version 8.0
.target sm_80
.address_size 64
{before}
.visible .entry probe(.param .u64 given, .param .u64 found)
{{
    .reg .pred %p<9>;
    .reg .b16 %rs<9>;
    .reg .b32 %r<99>;
    .reg .f32 %f<99>;
    .reg .f64 %fd<99>;
    .reg .b64 %rd<99>;
    ld.param.u64 %rd90, [given];
    ld.param.u64 %rd91, [found];
    mov.u32 %r90, %tid.x;
    mul.wide.u32 %rd92, %r90, 32;
    add.s64 %rd90, %rd90, %rd92;
    add.s64 %rd91, %rd91, %rd92;
    {code}
    ret;
}}
"""


def probe(code, given=b"", threads=1, before="", order=None):
    """Bytes that ``code`` writes from %rd91 on, 32 a thread; it reads from %rd90 on, 32 a thread."""
    source = np.zeros(32 * threads, np.uint8)
    source[: len(given)] = np.frombuffer(bytes(given), np.uint8)
    found = np.zeros(32 * threads, np.uint8)
    params = [ctypes.c_uint64(a.ctypes.data) for a in (source, found)]
    ptx.run(ENTRY.format(code=code, before=before), "probe", params, blocks=1, block_dim=threads, order=order)
    return found.tobytes()


def words(*values):
    return struct.pack(f"<{len(values)}I", *(v % 2**32 for v in values))


def floats(*values):
    return struct.pack(f"<{len(values)}f", *values)


def of_words(instruction, *values):
    """A 32-bit result of 32-bit operands %r1, %r2, ..."""
    loads = " ".join(f"ld.global.u32 %r{k + 1}, [%rd90+{4 * k}];" for k in range(len(values)))
    found = probe(f"{loads} {instruction} st.global.u32 [%rd91], %r9;", words(*values))
    return struct.unpack_from("<I", found)[0]


@pytest.mark.parametrize(
    ("instruction", "values", "expected"),
    [
        ("add.s32 %r9, %r1, %r2;", (2**31 - 1, 1), 2**31),
        ("sub.u32 %r9, %r1, %r2;", (1, 2), 2**32 - 1),
        ("mul.hi.u32 %r9, %r1, %r2;", (2**31 + 3, 2**31), (2**31 + 3) * 2**31 >> 32),
        ("mul.hi.s32 %r9, %r1, %r2;", (-3, 2**30), (-3 * 2**30 >> 32) % 2**32),
        ("mad.lo.s32 %r9, %r1, %r2, %r3;", (-7, 9, 5), (-58) % 2**32),
        ("div.s32 %r9, %r1, %r2;", (-7, 2), (-3) % 2**32),
        ("rem.s32 %r9, %r1, %r2;", (-7, 2), (-1) % 2**32),
        ("shl.b32 %r9, %r1, %r2;", (3, 40), 0),
        ("shr.s32 %r9, %r1, %r2;", (-8, 99), 2**32 - 1),
        ("shr.u32 %r9, %r1, %r2;", (2**31, 31), 1),
        ("shf.l.wrap.b32 %r9, %r1, %r2, %r3;", (0x12345678, 0x9ABCDEF0, 8), 0xBCDEF012),
        ("shf.r.clamp.b32 %r9, %r1, %r2, %r3;", (0x12345678, 0x9ABCDEF0, 40), 0x9ABCDEF0),
        ("prmt.b32 %r9, %r1, %r2, 0x7610;", (0x33221100, 0x77665544), 0x77661100),
        ("prmt.b32 %r9, %r1, %r2, 0x8;", (0x80, 0), 0x808080FF),
        ("bfe.s32 %r9, %r1, 4, 8;", (0xFF0,), 2**32 - 1),
        ("bfe.u32 %r9, %r1, 4, 8;", (0xFF0,), 0xFF),
        ("bfi.b32 %r9, %r1, %r2, 8, 4;", (0xA, 0xFFFFF0FF), 0xFFFFFAFF),
        ("bfind.u32 %r9, %r1;", (0x00100000,), 20),
        ("bfind.shiftamt.u32 %r9, %r1;", (0x00100000,), 11),
        ("bfind.s32 %r9, %r1;", (-1,), 2**32 - 1),
        ("brev.b32 %r9, %r1;", (0x1,), 2**31),
        ("clz.b32 %r9, %r1;", (0,), 32),
        ("popc.b32 %r9, %r1;", (0xF0F0,), 8),
        ("lop3.b32 %r9, %r1, %r2, %r3, 0xca;", (0xFF00, 0x1234, 0xABCD), 0x12CD),
        ("min.s32 %r9, %r1, %r2;", (-1, 1), 2**32 - 1),
        ("min.u32 %r9, %r1, %r2;", (-1, 1), 1),
        ("abs.s32 %r9, %r1;", (-5,), 5),
        ("add.cc.u32 %r4, %r1, %r2; addc.u32 %r9, 0, 0;", (-1, 1), 1),
        ("sub.cc.u32 %r4, %r1, %r2; subc.u32 %r9, %r1, 0;", (0, 1), 2**32 - 1),
        ("cvt.s8.s32 %rs1, %r1; cvt.s32.s8 %r9, %rs1;", (0x180,), (-128) % 2**32),
        ("cvt.sat.u8.s32 %rs1, %r1; cvt.u32.u16 %r9, %rs1;", (300,), 255),
        ("setp.lo.u32 %p1, %r1, %r2; selp.b32 %r9, 1, 0, %p1;", (1, -1), 1),
        ("setp.lt.and.s32 %p1|%p2, %r1, %r2, %p3; selp.b32 %r9, 1, 0, %p2;", (1, 2), 0),
        ("@!%p1 bra over; mov.u32 %r9, 1; bra.uni done; over: mov.u32 %r9, 2; done:", (), 2),
    ],
)
def test_integer_instructions(instruction, values, expected):
    assert of_words(instruction, *values) == expected


NAN = float("nan")
INF = float("inf")
TINY = 2.0**-149


@pytest.mark.parametrize(
    ("instruction", "values", "expected"),
    [
        ("fma.rn.f32 %f9, %f1, %f2, %f3;", (1 + 2**-12, 1 + 2**-12, -1 - 2**-11), 2.0**-24),
        ("mul.f32 %f9, %f1, %f2; add.f32 %f9, %f9, %f3;", (1 + 2**-12, 1 + 2**-12, -1 - 2**-11), 0.0),
        ("add.rz.f32 %f9, %f1, %f2;", (1.0, -(2.0**-40)), 1 - 2**-24),
        ("add.rm.f32 %f9, %f1, %f2;", (-1.0, -(2.0**-40)), -1 - 2**-23),
        ("add.rp.f32 %f9, %f1, %f2;", (1.0, 2.0**-40), 1 + 2**-23),
        ("add.rp.f32 %f9, %f1, %f2;", (1.0, 1.0), 2.0),
        ("mul.rm.f32 %f9, %f1, %f2;", (1 + 2**-23, 1 + 2**-23), 1 + 2**-22),
        ("mul.rp.f32 %f9, %f1, %f2;", (1 + 2**-23, 1 + 2**-23), 1 + 3 * 2**-23),
        ("fma.rm.f32 %f9, %f1, %f2, %f3;", (1.0, -(2.0**-60), 8.0), 8 - 2**-21),
        ("add.ftz.f32 %f9, %f1, %f2;", (TINY, 0.0), 0.0),
        ("add.f32 %f9, %f1, %f2;", (TINY, TINY), 2 * TINY),
        ("add.sat.f32 %f9, %f1, %f2;", (0.75, 0.75), 1.0),
        ("min.f32 %f9, %f1, %f2;", (NAN, 3.0), 3.0),
        ("max.f32 %f9, %f1, %f2;", (3.0, NAN), 3.0),
        ("max.NaN.f32 %f9, %f1, %f2;", (3.0, NAN), NAN),
        ("div.rn.f32 %f9, %f1, %f2;", (1.0, 3.0), float(np.float32(1) / np.float32(3))),
        ("rcp.rn.f32 %f9, %f1;", (0.0,), INF),
        ("sqrt.rn.f32 %f9, %f1;", (2.0,), float(np.sqrt(np.float32(2)))),
        ("rsqrt.approx.f32 %f9, %f1;", (4.0,), 0.5),
        ("ex2.approx.ftz.f32 %f9, %f1;", (-3.0,), 0.125),
        ("lg2.approx.f32 %f9, %f1;", (8.0,), 3.0),
        ("neg.f32 %f9, %f1; copysign.f32 %f9, %f9, %f2;", (1.0, 5.0), -5.0),
        ("abs.f32 %f9, %f1;", (-2.0,), 2.0),
        ("cvt.rmi.f32.f32 %f9, %f1;", (-1.5,), -2.0),
        ("cvt.rni.f32.f32 %f9, %f1;", (2.5,), 2.0),
        ("cvt.rzi.f32.f32 %f9, %f1;", (-1.5,), -1.0),
        ("cvt.rpi.f32.f32 %f9, %f1;", (1.25,), 2.0),
        ("cvt.sat.f32.f32 %f9, %f1;", (NAN,), 0.0),
        ("cvt.f64.f32 %fd1, %f1; cvt.rn.f32.f64 %f9, %fd1;", (0.1,), float(np.float32(0.1))),
        ("mov.f64 %fd1, 0d3FB999999999999A; cvt.rz.f32.f64 %f9, %fd1;", (), float.fromhex("0x1.999998p-4")),
        ("mov.f64 %fd1, 0d3FB999999999999A; cvt.rp.f32.f64 %f9, %fd1;", (), float.fromhex("0x1.99999ap-4")),
        ("mov.u32 %r1, -1; cvt.rn.f32.u32 %f9, %r1;", (), 2.0**32),
        ("mov.u32 %r1, -1; cvt.rz.f32.u32 %f9, %r1;", (), 2.0**32 - 256),
        ("mov.f32 %f9, 0f3F800000;", (), 1.0),
    ],
)  # fmt: skip
def test_floating_point_instructions(instruction, values, expected):
    loads = " ".join(f"ld.global.f32 %f{k + 1}, [%rd90+{4 * k}];" for k in range(len(values)))
    found = probe(f"{loads} {instruction} st.global.f32 [%rd91], %f9;", floats(*values))
    (result,) = struct.unpack_from("<f", found)
    assert result == expected or (math.isnan(result) and math.isnan(expected))


@pytest.mark.parametrize(
    ("conversion", "value", "expected"),
    [
        ("cvt.rzi.s32.f32", 3e9, 2**31 - 1),
        ("cvt.rzi.s32.f32", NAN, 0),
        ("cvt.rzi.u32.f32", -5.0, 0),
        ("cvt.rni.s32.f32", -2.5, -2),
        ("cvt.rmi.s32.f32", -2.5, -3),
        ("cvt.rpi.s32.f32", -2.5, -2),
        ("cvt.rzi.u32.f32", 4e9, 4_000_000_000),
    ],
)
def test_floats_become_integers_rounded_and_clamped(conversion, value, expected):
    found = probe(
        f"ld.global.f32 %f1, [%rd90]; {conversion} %r9, %f1; st.global.u32 [%rd91], %r9;", floats(value)
    )
    assert struct.unpack_from("<I", found)[0] == expected % 2**32


@pytest.mark.parametrize(
    ("comparison", "ordered", "with_nan"),
    [
        ("eq", False, False), ("ne", True, False), ("lt", True, False), ("le", True, False), ("gt", False, False),
        ("ge", False, False), ("equ", False, True), ("neu", True, True), ("ltu", True, True), ("geu", False, True),
        ("num", True, False), ("nan", False, True),
    ],
)  # fmt: skip
def test_comparisons_with_nan_are_false_unless_unordered(comparison, ordered, with_nan):
    code = (
        f"ld.global.f32 %f1, [%rd90]; ld.global.f32 %f2, [%rd90+4]; setp.{comparison}.f32 %p1, %f1, %f2;"
        " selp.u32 %r9, 1, 0, %p1; st.global.u32 [%rd91], %r9;"
    )
    assert probe(code, floats(1, 2))[0] == ordered
    assert probe(code, floats(1, NAN))[0] == with_nan


def test_vector_accesses_and_halves_of_registers():
    found = probe(
        """
        ld.global.v4.u32 {%r1, %r2, %r3, %r4}, [%rd90];
        mov.b64 %rd1, {%r1, %r2}; mov.b64 {%r5, %r6}, %rd1; add.s64 %rd1, %rd1, 1;
        st.global.v2.u32 [%rd91], {%r6, %r5}; st.global.u64 [%rd91+8], %rd1;
        { .reg .b32 %r1; mov.u32 %r1, 77; st.global.u32 [%rd91+16], %r1; }
        st.global.u32 [%rd91+20], %r1;
        """,
        words(1, 2, 3, 4),
    )
    assert struct.unpack("<IIQII", found[:24]) == (2, 1, (2 << 32 | 1) + 1, 77, 1)


def test_device_functions_constants_and_jump_tables():
    before = """
    .const .align 4 .u32 table[3] = {10, 20, 30};
    .func (.param .b32 out) twice(.param .b32 in)
    {
        .reg .b32 %r<3>;
        ld.param.u32 %r1, [in];
        add.u32 %r2, %r1, %r1;
        st.param.b32 [out], %r2;
        ret;
    }
    """
    found = probe(
        """
        ld.const.u32 %r1, [table+4];
        { .param .b32 p; .param .b32 q; st.param.b32 [p], %r1;
        call.uni (q), twice, (p);
        ld.param.b32 %r2, [q]; }
        targets: .branchtargets zero, one;
        brx.idx 1, targets;
        zero: add.u32 %r2, %r2, 100; bra.uni done;
        one: add.u32 %r2, %r2, 1;
        done: st.global.u32 [%rd91], %r2;
        """,
        before=before,
    )
    assert struct.unpack_from("<I", found)[0] == 41


def lanes(code, threads=32, order=None):
    """A 32-bit number %r9 from each thread; %r90 is the thread."""
    found = probe(f"{code} st.global.u32 [%rd91], %r9;", threads=threads, order=order)
    return list(struct.unpack(f"<{8 * threads}I", found)[::8])


@pytest.mark.parametrize(
    ("shuffle", "expected"),
    [
        ("shfl.sync.up.b32 %r9, %r1, 3, 0, -1;", [max(i - 3, 0) if i >= 3 else i for i in range(32)]),
        ("shfl.sync.down.b32 %r9, %r1, 4, 31, -1;", [i + 4 if i < 28 else i for i in range(32)]),
        ("shfl.sync.bfly.b32 %r9, %r1, 5, 31, -1;", [i ^ 5 for i in range(32)]),
        ("shfl.sync.idx.b32 %r9, %r1, 7, 31, -1;", [7] * 32),
        # Segments of 8 lanes: c = (32 - 8) << 8 | 31
        ("shfl.sync.idx.b32 %r9, %r1, 2, 0x181f, -1;", [i // 8 * 8 + 2 for i in range(32)]),
        ("shfl.sync.down.b32 %r9, %r1, 1, 0x181f, -1;", [i + 1 if i % 8 < 7 else i for i in range(32)]),
        ("shfl.sync.down.b32 %r2|%p1, %r1, 4, 31, -1; selp.u32 %r9, 1, 0, %p1;", [int(i < 28) for i in range(32)]),
    ],
)  # fmt: skip
@pytest.mark.parametrize("order", [None, "reversed", 3])
def test_shuffles(shuffle, expected, order):
    assert lanes(f"mov.u32 %r1, %r90; {shuffle}", order=order) == expected


def test_votes_matches_and_reductions_of_a_part_of_a_warp():
    odd = "and.b32 %r1, %r90, 1; setp.eq.u32 %p1, %r1, 1;"
    assert lanes(f"{odd} vote.sync.ballot.b32 %r9, %p1, -1;") == [0xAAAAAAAA] * 32
    assert lanes(f"{odd} vote.sync.all.pred %p2, %p1, -1; selp.u32 %r9, 1, 0, %p2;") == [0] * 32
    assert lanes(f"{odd} vote.sync.any.pred %p2, %p1, -1; selp.u32 %r9, 1, 0, %p2;") == [1] * 32
    assert lanes(f"{odd} match.any.sync.b32 %r9, %r1, -1;") == [0x55555555, 0xAAAAAAAA] * 16
    mine = f"{odd} mov.u32 %r9, 0; @!%p1 bra out; redux.sync.add.s32 %r9, %r90, 0xAAAAAAAA; out:"
    assert lanes(mine) == [0, sum(range(1, 32, 2))] * 16
    assert lanes("redux.sync.max.u32 %r9, %r90, -1;") == [31] * 32
    assert lanes(f"{odd} mov.u32 %r9, 0; @!%p1 bra out; activemask.b32 %r9; out:") == [0, 0xAAAAAAAA] * 16


@pytest.mark.parametrize("order", [None, "reversed", 0, 1])
def test_a_barrier_orders_shared_memory_for_the_whole_block(order):
    code = """
    .shared .align 4 .b8 box[512];
    mov.u32 %r1, box; shl.b32 %r2, %r90, 2; add.s32 %r3, %r1, %r2; st.shared.u32 [%r3], %r90;
    bar.sync 0;
    sub.s32 %r4, 508, %r2; add.s32 %r5, %r1, %r4; ld.shared.u32 %r9, [%r5];
    """
    assert lanes(code, 128, order) == list(range(127, -1, -1))
    without = code.replace("bar.sync 0;", "")
    assert lanes(without, 128, order) != list(range(127, -1, -1))
    counted = "setp.lt.u32 %p1, %r90, 40; bar.red.popc.u32 %r9, 0, %p1;"
    assert lanes(counted, 128, order) == [40] * 128


def test_shared_memory_never_written_holds_nan():
    found = lanes(".shared .align 4 .b8 box[16]; mov.u32 %r1, box; ld.shared.u32 %r9, [%r1+8];", 1)
    assert np.isnan(np.array(found, np.uint32).view(np.float32)).all()


@pytest.mark.parametrize(
    ("code", "message"),
    [
        ("setp.lt.u32 %p1, %r90, 7; @%p1 bra a; bar.sync 0; bra b; a: bar.sync 1; b:", "deadlock: threads 0 to 6 at barrier 1"),
        ("setp.lt.u32 %p1, %r90, 7; @%p1 bra a; bar.sync 0; bra b; a: bar.sync 0; b:", "different instructions for one barrier"),
        ("setp.eq.u32 %p1, %r90, 3; @%p1 bra a; bar.warp.sync -1; bra b; a: bar.sync 0; b:", "deadlock: threads 0 to 2, 4 to 31"),
        ("setp.eq.u32 %p1, %r90, 3; @%p1 exit; shfl.sync.idx.b32 %r9, %r90, 3, 31, -1;", "shuffle from lane 3"),
        ("shfl.sync.idx.b32 %r9, %r90, 0, 31, 1;", "not in the mask"),
        ("mov.u64 %rd1, 8; ld.global.u32 %r9, [%rd1];", "no memory"),
        ("ld.global.u64 %rd1, [%rd90+4];", "not aligned"),
        (".shared .align 4 .b8 box[16]; mov.u32 %r1, box; ld.shared.u32 %r9, [%r1+16];", "beyond its 16"),
        ("trap;", "trap"),
    ],
)  # fmt: skip
def test_what_a_gpu_would_not_do_is_reported(code, message):
    with pytest.raises(ptx.Fault, match=message):
        lanes(code)


def test_a_loop_without_end_is_reported(monkeypatch):
    monkeypatch.setattr(ptx, "BUDGET", 1000)
    with pytest.raises(ptx.Fault, match="does not end"):
        lanes("again: bra again;", 1)


@pytest.mark.parametrize(
    "code", ["wgmma.fence.sync.aligned;", "add.rx.f32 %f1, %f1, %f1;", "mov.u32 %r1, %clock;"]
)
def test_what_is_not_known_is_refused_by_name(code):
    with pytest.raises(
        ptx.UnknownPtx, match=code.split()[-1 if "clock" in code else 0].strip(";").replace(".", r"\.")
    ):
        probe(code)


# Kernels of Warp


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ float part[32];
    for (int o = 16; o > 0; o >>= 1) x += __shfl_down_sync(0xffffffffu, x, o);
    if ((threadIdx.x & 31) == 0) part[threadIdx.x >> 5] = x;
    __syncthreads();
    float total = 0.0f;
    for (int i = 0; i < blockDim.x / 32; ++i) total += part[i];
    __syncthreads();
    return total;
#else
    return x;
#endif
""")
def block_total(x: float) -> float: ...


@wp.kernel(enable_backward=False)
def block_totals(given: wp.array(dtype=float), out: wp.array(dtype=float)):
    i = wp.tid()
    out[i] = block_total(given[i])


@pytest.mark.parametrize("block_dim", [32, 64, 256])
def test_a_block_adds_up_by_shuffles(block_dim):
    given = np.random.default_rng(0).uniform(size=4 * block_dim).astype(np.float32)
    out = wp.zeros(given.size, dtype=float, device="cpu")
    counts = ptx.launch(
        block_totals,
        given.size,
        [wp.array(given, device="cpu"), out],
        block_dim=block_dim,
        order=5,
        count=True,
    )
    expected = given.reshape(4, -1).astype(np.float64).sum(axis=1)
    np.testing.assert_allclose(out.numpy().reshape(4, -1), np.tile(expected[:, None], block_dim), rtol=1e-6)
    assert counts["shuffles"] == 5 * given.size
    assert counts["barriers"] == 2 * given.size
    assert counts["global_loads_bytes"] == counts["global_stores_bytes"] == 4 * given.size


@wp.kernel
def tile_totals(given: wp.array2d(dtype=float), out: wp.array(dtype=float)):
    i, _ = wp.tid()
    wp.tile_store(out, wp.tile_sum(wp.tile_load(given[i], shape=256)), offset=i)


@wp.kernel(enable_backward=False)
def tile_products(a: wp.array2d(dtype=float), b: wp.array2d(dtype=float), out: wp.array2d(dtype=float)):
    _i, _ = wp.tid()
    x = wp.tile_load(a, shape=(16, 16), storage="shared")
    y = wp.tile_load(b, shape=(16, 16), storage="shared")
    wp.tile_store(out, wp.tile_map(wp.mul, x, wp.tile_transpose(y)))


@pytest.mark.parametrize("block_dim", [64, 256])
@pytest.mark.parametrize("order", [None, "reversed"])
def test_tiles_and_their_adjoint(block_dim, order):
    given = np.random.default_rng(1).uniform(size=(3, 256)).astype(np.float32)
    source = wp.array(given, device="cpu", requires_grad=True)
    out = wp.zeros(3, dtype=float, device="cpu", requires_grad=True)
    ptx.launch(tile_totals, (3, block_dim), [source, out], block_dim=block_dim, order=order)
    np.testing.assert_allclose(out.numpy(), given.astype(np.float64).sum(axis=1), rtol=1e-6)
    out.grad = wp.array([1.0, 2.0, 3.0], dtype=float, device="cpu")
    ptx.launch(tile_totals, (3, block_dim), [source, out], block_dim=block_dim, order=order, adjoint=True)
    np.testing.assert_array_equal(source.grad.numpy(), np.repeat([[1.0], [2.0], [3.0]], 256, axis=1))
    a, b = (np.random.default_rng(k).uniform(size=(16, 16)).astype(np.float32) for k in (2, 3))
    product = wp.zeros((16, 16), dtype=float, device="cpu")
    inputs = [wp.array(x, device="cpu") for x in (a, b)]
    ptx.launch(tile_products, (1, block_dim), [*inputs, product], block_dim=block_dim, order=order)
    np.testing.assert_array_equal(product.numpy(), a * b.T)


@wp.struct
class Bag:
    numbers: wp.array(dtype=wp.vec3d)
    scale: wp.float64
    shift: wp.vec3d


@wp.kernel
def atomics(
    bag: Bag, bins: wp.array(dtype=int), most: wp.array(dtype=float), total: wp.array(dtype=wp.vec3d)
):
    i = wp.tid()
    x = bag.numbers[i] * bag.scale + bag.shift
    wp.atomic_add(bins, i % 7, 1)
    wp.atomic_max(most, 0, float(x[0]))
    wp.atomic_add(total, 0, wp.vec3d(wp.sin(x[0]), wp.exp(x[1]), wp.log(x[2] + wp.float64(2.0))))


def test_structs_atomics_and_the_adjoint_agree_with_the_cpu():
    rng = np.random.default_rng(2)
    found = []
    for run in (wp.launch, ptx.launch):
        bag = Bag()
        bag.numbers = wp.array(
            rng.uniform(size=(500, 3)) if not found else numbers, dtype=wp.vec3d, device="cpu"
        )
        numbers = bag.numbers.numpy()
        bag.numbers.requires_grad = True
        bag.scale, bag.shift = 3.0, wp.vec3d(0.1, 0.2, 0.3)
        out = [
            wp.zeros(7, dtype=int, device="cpu"),
            wp.zeros(1, dtype=float, device="cpu", requires_grad=True),
            wp.zeros(1, dtype=wp.vec3d, device="cpu", requires_grad=True),
        ]
        device = {"device": "cpu"} if run is wp.launch else {}
        run(atomics, 500, [bag, *out], **device)
        out[2].grad = wp.array([[1.0, -1.0, 2.0]], dtype=wp.vec3d, device="cpu")
        slopes = {"adj_inputs": [Bag(), None, None, None]} if run is wp.launch else {}
        run(atomics, 500, [bag, *out], adjoint=True, **slopes, **device)
        found.append([*(o.numpy() for o in out), bag.numbers.grad.numpy()])
    for cpu, cuda in zip(*found, strict=True):
        np.testing.assert_allclose(cuda, cpu, rtol=1e-12)


@wp.kernel(enable_backward=False)
def strided(out: wp.array(dtype=int)):
    i = wp.tid()
    out[i] = out[i] + i + 1


def test_few_blocks_stride_over_the_grid():
    out = wp.zeros(1000, dtype=int, device="cpu")
    ptx.launch(strided, 1000, [out], block_dim=64, blocks=3)
    np.testing.assert_array_equal(out.numpy(), np.arange(1000) + 1)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __shared__ float box[64];
    box[threadIdx.x] = x;
    return box[63 - threadIdx.x];
#else
    return x;
#endif
""")
def careless_neighbour(x: float) -> float: ...


@wp.kernel(enable_backward=False)
def careless(given: wp.array(dtype=float), out: wp.array(dtype=float)):
    i = wp.tid()
    out[i] = careless_neighbour(given[i])


def test_a_barrier_left_out_shows_in_another_order():
    given = wp.array(np.arange(64), dtype=float, device="cpu")
    results = []
    for order in (None, "reversed"):
        out = wp.zeros(64, dtype=float, device="cpu")
        ptx.launch(careless, 64, [given, out], block_dim=64, order=order)
        results.append(out.numpy())
    assert not np.array_equal(*results)
    assert np.isnan(results[0]).any()


@wp.kernel(enable_backward=False)
def printing(n: int, x: float):
    wp.printf("%d and %.2f, %s\n", n, x, "all")


def test_a_kernel_prints(capfd):
    ptx.launch(printing, 1, [-3, 2.5], block_dim=32)
    assert capfd.readouterr().out == "-3 and 2.50, all\n"


def test_resources_are_those_of_the_machine_code():
    few = ptx.resources(strided)["forward"]
    assert 8 <= few.registers <= 64
    assert few.local_bytes == 0
    shared = ptx.resources(block_totals)["forward"].shared_bytes
    assert shared - few.shared_bytes == 128  # 32 floats
    assert set(ptx.resources(atomics)) == {"forward", "backward"}


def test_arguments_that_do_not_fit_are_refused():
    out = wp.zeros(4, dtype=int, device="cpu")
    with pytest.raises(ValueError, match="inputs: got 2"):
        ptx.launch(strided, 4, [out, out])
    with pytest.raises(ValueError, match="order: got 'random'"):
        ptx.launch(strided, 4, [out], order="random")
    with pytest.raises(ValueError, match="block_dim: got 2000"):
        ptx.launch(strided, 4, [out], block_dim=2000)
