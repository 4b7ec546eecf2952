// What translated PTX runs on: the types and arithmetic of its instructions (NVIDIA, PTX ISA 9.0, chapters 9 and 10) and
// the scheduler that runs the threads of a block as coroutines. A thread runs until it must wait for others: at a
// barrier, a shuffle, a vote. All addresses are the host's, but shared ones are offsets into the block's buffer, since
// PTX keeps them in 32 bits. The translated kernel is compiled behind this file.

typedef unsigned char u8;
typedef signed char s8;
typedef unsigned short u16;
typedef short s16;
typedef unsigned int u32;
typedef int s32;
typedef unsigned long long u64;
typedef long long s64;
typedef float f32;
typedef double f64;
typedef unsigned __int128 u128;
typedef __int128 s128;

#define INLINE static inline __attribute__((always_inline))
#define UNLIKELY(x) __builtin_expect(!!(x), 0)

extern "C" float exp2f(float);
extern "C" float log2f(float);
extern "C" float sinf(float);
extern "C" float cosf(float);
extern "C" float tanhf(float);
extern "C" void* memset(void*, int, unsigned long);
extern "C" void* memcpy(void*, const void*, unsigned long);
extern "C" int _setjmp(void*) __attribute__((returns_twice));
extern "C" void longjmp(void*, int) __attribute__((noreturn));

enum State : u32 { READY, WAITING, FINISHED };
enum Wait : u32 { NOTHING, BARRIER, WARP_BARRIER, SHUFFLE, VOTE, MATCH, REDUCE, ACTIVE_MASK };
enum Fault : u32 {
    NO_FAULT, TRAP, BAD_ADDRESS, MISALIGNED, OUT_OF_SHARED, DEADLOCK, NOT_IN_MASK, SHUFFLE_FROM_ABSENT, DIVERGED_BARRIER,
    TOO_LONG, ASSERTION, TOO_MANY_ARRIVED
};

struct Thread {
    u32 state;
    u32 wait;      // what for
    u32 site;      // instruction at which the thread waits, for messages
    u32 kind;      // mode of the shuffle, vote or reduction
    u32 mask;      // lanes that take part; a barrier's number
    u32 count;     // threads that a barrier waits for, 0: all
    u64 value;     // what the thread brings, and what it gets
    u32 lane_from; // a shuffle's second and third operands
    u32 clamp;
    u32 flag;      // predicate brought, and got
    u32 arrives;   // a barrier at which the thread does not wait
};

// The same layout as ``Launch`` in Python.
struct Context {
    void** params;
    char* shared;
    u64 shared_bytes;
    Thread* threads;
    char* registers;
    const u32* lane_order;
    const u32* warp_order;
    const u64* block_order;
    u64* counts;
    void (*print)(const char*, const char*);
    u64 blocks;
    u64 block;
    s64 budget; // backward branches left
    u64 address;
    u32 block_dim;
    u32 thread;
    u32 fault;
    u32 site;
    u32 arrived[16]; // threads at each barrier that did not wait there
    void* jump; // where a fault leads: the C library's jmp_buf
};

// A fault leaves the launch: no frame in between has anything to undo.
static __attribute__((noinline, noreturn, cold)) void fault(Context* C, u32 what, u32 site)
{
    C->fault = what;
    C->site = site;
    longjmp(C->jump, 1);
}

// One comparison finds null pointers (and what is little beyond) and addresses that are not multiples of 2^k.
INLINE bool bad_address(u64 a, u32 k)
{
    const u64 b = a - 65536;
    return (k ? (b >> k) | (b << (64 - k)) : b) >> (48 - k) != 0;
}
INLINE bool bad_shared(const Context* C, u64 a, u32 size, u32 align)
{
    return (u32)a + (u64)size > C->shared_bytes || (a & (align - 1)) != 0;
}

static __attribute__((noinline, noreturn, cold)) void bad_memory_access(Context* C, u64 a, u32 site)
{
    C->address = a;
    fault(C, a < 65536 || a >> 48 ? BAD_ADDRESS : MISALIGNED, site);
}
static __attribute__((noinline, noreturn, cold)) void bad_shared_access(Context* C, u64 a, u32 site)
{
    C->address = a;
    fault(C, OUT_OF_SHARED, site);
}

template <class T, class S> INLINE T rd(S x)
{
    if constexpr (__is_same(T, S)) return x;
    else if constexpr (__is_same(T, f32) || __is_same(T, f64) || __is_same(S, f32) || __is_same(S, f64)) {
        static_assert(sizeof(T) == sizeof(S), "a floating-point register is read as a type of another size");
        return __builtin_bit_cast(T, x);
    } else return (T)x;
}

template <class D, class S> INLINE void wr(D& d, S x) { d = rd<D>(x); }

template <class T> INLINE T ldm(u64 a)
{
    T x;
    __builtin_memcpy(&x, (const void*)a, sizeof(T));
    return x;
}

template <class T> INLINE void stm(u64 a, T x) { __builtin_memcpy((void*)a, &x, sizeof(T)); }

// Integers

template <class T> INLINE T shift_left(T x, u32 n) { return n >= 8 * sizeof(T) ? 0 : (T)(x << n); }
template <class T> INLINE T shift_right(T x, u32 n)
{
    const u32 most = 8 * sizeof(T) - 1;
    if (n > most) return T(-1) < T(0) ? (T)(x >> most) : T(0);
    return (T)(x >> n);
}
template <class T> INLINE T quotient(T a, T b)  // PTX leaves division by zero open; on the machine all bits are set
{
    if (b == 0) return (T)-1;
    if (T(-1) < T(0) && b == (T)-1) return (T)(0 - (u64)a);
    return a / b;
}
template <class T> INLINE T remainder(T a, T b)
{
    if (b == 0) return a;
    if (T(-1) < T(0) && b == (T)-1) return 0;
    return a % b;
}
template <class T> INLINE T reversed(T x)
{
    T y = 0;
    for (u32 i = 0; i < 8 * sizeof(T); ++i) y |= ((x >> i) & 1) << (8 * sizeof(T) - 1 - i);
    return y;
}
INLINE u32 leading_zeros(u64 x, u32 bits) { return x ? __builtin_clzll(x) - (64 - bits) : bits; }
template <class T> INLINE u32 highest_bit(T x, bool shift_amount)
{
    const u32 bits = 8 * sizeof(T);
    u64 y = (u64)x;
    if (T(-1) < T(0) && x < 0) y = (u64)~x;
    if (bits == 32) y &= 0xffffffffull;
    if (!y) return 0xffffffffu;
    const u32 place = 63 - __builtin_clzll(y);
    return shift_amount ? bits - 1 - place : place;
}
template <class T, class U> INLINE T field(T x, u32 place, u32 length)  // T: the type, U: the same without sign
{
    const u32 bits = 8 * sizeof(T), most = bits - 1;
    place &= 255;
    length &= 255;
    const bool is_signed = T(-1) < T(0);
    const u32 last = place + length - 1 < most ? place + length - 1 : most;
    const U sign = !is_signed || length == 0 ? 0 : (U)((U)x >> last) & 1;
    U y = sign ? (U)~(U)0 : 0;
    for (u32 i = 0; i < length && i < bits; ++i) {
        const U bit = place + i <= most ? ((U)x >> (place + i)) & 1 : sign;
        y = (y & ~((U)1 << i)) | (bit << i);
    }
    return (T)y;
}
template <class T> INLINE T with_field(T a, T b, u32 place, u32 length)
{
    place &= 255;
    length &= 255;
    for (u32 i = 0; i < length && place + i < 8 * sizeof(T); ++i)
        b = (b & ~((T)1 << (place + i))) | (((a >> i) & 1) << (place + i));
    return b;
}
INLINE u32 funnel(u32 a, u32 b, u32 n, bool left, bool wrap)
{
    n = wrap ? n & 31 : (n > 32 ? 32 : n);
    const u64 both = ((u64)b << 32) | a;
    return left ? (u32)((both << n) >> 32) : (u32)(both >> n);
}
INLINE u32 permuted(u32 a, u32 b, u32 selection)
{
    const u64 both = ((u64)b << 32) | a;
    u32 y = 0;
    for (u32 i = 0; i < 4; ++i) {
        const u32 which = (selection >> (4 * i)) & 15;
        u32 byte = (both >> (8 * (which & 7))) & 255;
        if (which & 8) byte = byte & 128 ? 255 : 0;
        y |= byte << (8 * i);
    }
    return y;
}
INLINE u32 logic(u32 a, u32 b, u32 c, u32 table)
{
    u32 y = 0;
    for (u32 k = 0; k < 8; ++k)
        if ((table >> k) & 1) y |= (k & 4 ? a : ~a) & (k & 2 ? b : ~b) & (k & 1 ? c : ~c);
    return y;
}

// Floating point

INLINE f32 flushed(f32 x)
{
    const u32 b = __builtin_bit_cast(u32, x);
    return (b & 0x7f800000u) == 0 ? __builtin_bit_cast(f32, b & 0x80000000u) : x;
}
INLINE f64 flushed(f64 x) { return x; }
INLINE bool is_nan(f64 x) { return x != x; }
INLINE f32 magnitude(f32 x) { return __builtin_bit_cast(f32, __builtin_bit_cast(u32, x) & 0x7fffffffu); }
INLINE f64 magnitude(f64 x) { return __builtin_bit_cast(f64, __builtin_bit_cast(u64, x) & 0x7fffffffffffffffull); }
INLINE f32 negated(f32 x) { return __builtin_bit_cast(f32, __builtin_bit_cast(u32, x) ^ 0x80000000u); }
INLINE f64 negated(f64 x) { return __builtin_bit_cast(f64, __builtin_bit_cast(u64, x) ^ 0x8000000000000000ull); }
INLINE bool sign_of(f32 x) { return __builtin_bit_cast(u32, x) >> 31; }
INLINE bool sign_of(f64 x) { return __builtin_bit_cast(u64, x) >> 63; }
template <class T> INLINE T with_sign(T sign, T x) { return sign_of(sign) ? negated(magnitude(x)) : magnitude(x); }
template <class T> INLINE T least(T a, T b)
{
    if (a != a) return b;
    if (b != b) return a;
    if (a == b) return sign_of(a) ? a : b;
    return a < b ? a : b;
}
template <class T> INLINE T most(T a, T b)
{
    if (a != a) return b;
    if (b != b) return a;
    if (a == b) return sign_of(a) ? b : a;
    return a > b ? a : b;
}
template <class T> INLINE T saturated(T x) { return x != x ? (T)0 : (x < (T)0 ? (T)0 : (x > (T)1 ? (T)1 : x)); }
INLINE f32 fused(f32 a, f32 b, f32 c) { return __builtin_elementwise_fma(a, b, c); }
INLINE f64 fused(f64 a, f64 b, f64 c) { return __builtin_elementwise_fma(a, b, c); }
INLINE f32 root(f32 x) { return __builtin_elementwise_sqrt(x); }
INLINE f64 root(f64 x) { return __builtin_elementwise_sqrt(x); }
// The f64 approximations see and give the upper 32 bits only.
INLINE f64 upper(f64 x) { return __builtin_bit_cast(f64, __builtin_bit_cast(u64, x) & 0xffffffff00000000ull); }

// Directed rounding: from the value rounded to nearest, ``y``, and the sign of what is missing, exact - y.
enum Rounding { NEAREST, ZERO, DOWN, UP };
template <class T, class B> INLINE T next(T y, bool up)
{
    if (y != y) return y;
    B b = __builtin_bit_cast(B, y);
    const B sign = (B)1 << (8 * sizeof(B) - 1);
    if (y == (T)0) return __builtin_bit_cast(T, (B)(up ? 1 : sign | 1));
    return __builtin_bit_cast(T, (B)(((b & sign) != 0) == up ? b - 1 : b + 1));
}
template <class T, class B> INLINE T directed(T y, f64 missing, Rounding how)
{
    if (missing == 0 || missing != missing) return y;
    const bool positive = y > (T)0 || (y == (T)0 && missing > 0);
    if (how == DOWN || (how == ZERO && positive)) return missing < 0 ? next<T, B>(y, false) : y;
    if (how == UP || how == ZERO) return missing > 0 ? next<T, B>(y, true) : y;
    return y;
}
INLINE f64 two_sum_error(f64 a, f64 b, f64 s)
{
    const f64 bb = s - a;
    return (a - (s - bb)) + (b - bb);
}
INLINE f32 fused_to(f32 a, f32 b, f32 c, Rounding how)
{
    const f64 p = (f64)a * (f64)b, s = p + (f64)c, e = two_sum_error(p, c, s);  // p is exact, so is s + e
    const f32 y = fused(a, b, c);
    const f64 rest = s - (f64)y;
    return directed<f32, u32>(y, rest != 0 ? rest + e : e, how);
}
INLINE f32 sum_to(f32 a, f32 b, Rounding how) { return fused_to(a, 1.0f, b, how); }
INLINE f32 product_to(f32 a, f32 b, Rounding how) { return fused_to(a, b, 0.0f, how); }
INLINE f64 sum_to(f64 a, f64 b, Rounding how)
{
    const f64 s = a + b;
    return directed<f64, u64>(s, two_sum_error(a, b, s), how);
}
INLINE f64 product_to(f64 a, f64 b, Rounding how)
{
    const f64 p = a * b;
    return directed<f64, u64>(p, fused(a, b, -p), how);
}
INLINE f32 narrowed(f64 x, Rounding how) { return directed<f32, u32>((f32)x, x - (f64)(f32)x, how); }
template <class T> INLINE T whole(T x, Rounding how)
{
    switch (how) {
    case NEAREST: return __builtin_elementwise_roundeven(x);
    case ZERO: return __builtin_elementwise_trunc(x);
    case DOWN: return __builtin_elementwise_floor(x);
    default: return __builtin_elementwise_ceil(x);
    }
}
// To an integer: out of range is clamped; NaN is 0, but the highest bit alone from f64 or to 64 bits.
template <class T, class S> INLINE T to_integer(S x, Rounding how)
{
    const u32 bits = 8 * sizeof(T);
    const bool is_signed = T(-1) < T(0);
    if (x != x) return sizeof(S) == 8 || bits == 64 ? (T)((u64)1 << (bits - 1)) : (T)0;
    const f64 y = (f64)whole(x, how);
    const f64 above = is_signed ? (f64)((u64)1 << (bits - 1)) : 2.0 * (f64)((u64)1 << (bits - 1));
    if (y >= above) return is_signed ? (T)(((u64)1 << (bits - 1)) - 1) : (T)~(u64)0;
    if (is_signed ? y < -above : y < 0) return is_signed ? (T)((u64)1 << (bits - 1)) : (T)0;
    return (T)y;
}
template <class T, class S> INLINE T clamped(S x)
{
    const bool to_signed = T(-1) < T(0);
    const u32 bits = 8 * sizeof(T);
    const s128 low = to_signed ? -((s128)1 << (bits - 1)) : (s128)0;
    const s128 high = to_signed ? ((s128)1 << (bits - 1)) - 1 : ((s128)1 << bits) - 1;
    const s128 y = (s128)x;
    return (T)(y < low ? low : (y > high ? high : y));
}

// The scheduler

static void run_thread(Context* C, u32 t);

static void finish(Thread& T, u64 value, u32 flag)
{
    T.value = value;
    T.flag = flag;
    T.state = READY;
}

// Completes what the lanes of a warp wait for at ``first``; false where lanes that it names are still elsewhere.
static bool complete_warp(Context* C, Thread* W, u32 lanes, u32 first)
{
    Thread& F = W[first];
    const u32 kind = F.wait, mask = F.mask;
    if (kind == ACTIVE_MASK) return false;
    if (!((mask >> first) & 1)) {
        C->thread = (u32)(&F - C->threads);
        fault(C, NOT_IN_MASK, F.site);
    }
    u32 members = 0;
    for (u32 i = 0; i < lanes; ++i) {
        if (!((mask >> i) & 1) || W[i].state == FINISHED) continue;
        if (W[i].state != WAITING || W[i].wait != kind || W[i].kind != F.kind || W[i].mask != mask) return false;
        members |= 1u << i;
    }
    u64 value[32];
    u32 flag[32];
    u32 ballot = 0;
    for (u32 i = 0; i < lanes; ++i) {
        value[i] = W[i].value;
        flag[i] = W[i].flag;
        if ((members >> i) & 1 && flag[i]) ballot |= 1u << i;
    }
    u64 together = value[first];
    for (u32 i = first + 1; kind == REDUCE && i < lanes; ++i) {
        if (!((members >> i) & 1)) continue;
        const u32 a = (u32)together, b = (u32)value[i];
        switch (F.kind) {
        case 0: together = a + b; break;
        case 1: together = a < b ? a : b; break;
        case 2: together = a > b ? a : b; break;
        case 3: together = (s32)a < (s32)b ? a : b; break;
        case 4: together = (s32)a > (s32)b ? a : b; break;
        case 5: together = a & b; break;
        case 6: together = a | b; break;
        default: together = a ^ b;
        }
    }
    for (u32 i = 0; i < lanes; ++i) {
        if (!((members >> i) & 1)) continue;
        Thread& T = W[i];
        if (kind == WARP_BARRIER) finish(T, 0, 0);
        else if (kind == REDUCE) finish(T, together, 0);
        else if (kind == VOTE) {  // all, any, uni, ballot
            const bool all = ballot == members, any = ballot != 0;
            finish(T, ballot, F.kind == 0 ? all : F.kind == 1 ? any : all || !any);
        } else if (kind == MATCH) {  // any, all
            u32 same = 0;
            for (u32 j = 0; j < lanes; ++j)
                if ((members >> j) & 1 && value[j] == value[i]) same |= 1u << j;
            const bool all = same == members;
            finish(T, F.kind == 0 ? same : (all ? same : 0), all);
        } else {  // shuffle: up, down, bfly, idx
            const s32 b = T.lane_from & 31, cval = T.clamp & 31, segment = (T.clamp >> 8) & 31, lane = (s32)i;
            const s32 highest = (lane & segment) | (cval & ~segment), lowest = lane & segment;
            s32 from;
            bool inside;
            switch (F.kind) {
            case 0: from = lane - b; inside = from >= highest; break;
            case 1: from = lane + b; inside = from <= highest; break;
            case 2: from = lane ^ b; inside = from <= highest; break;
            default: from = lowest | (b & ~segment); inside = from <= highest;
            }
            if (!inside) from = lane;
            if (!((members >> from) & 1)) {
                C->thread = (u32)(&T - C->threads);
                C->address = (u64)from;
                fault(C, SHUFFLE_FROM_ABSENT, T.site);
            }
            finish(T, value[from], inside);
        }
    }
    return true;
}

static bool complete_warps(Context* C, Thread* W, u32 lanes)
{
    bool any = false;
    for (u32 i = 0; i < lanes; ++i)
        if (W[i].state == WAITING && W[i].wait != BARRIER) any |= complete_warp(C, W, lanes, i);
    if (any) return true;
    for (u32 i = 0; i < lanes; ++i) {  // nothing else moves: the lanes at one such instruction are active together
        if (W[i].state != WAITING || W[i].wait != ACTIVE_MASK) continue;
        u32 mask = 0;
        for (u32 j = 0; j < lanes; ++j)
            if (W[j].state == WAITING && W[j].wait == ACTIVE_MASK && W[j].site == W[i].site) mask |= 1u << j;
        for (u32 j = 0, site = W[i].site; j < lanes; ++j)
            if ((mask >> j) & 1 && W[j].site == site) finish(W[j], mask, 0);
        return true;
    }
    return false;
}

static bool complete_barriers(Context* C)
{
    const u32 n = C->block_dim;
    u32 live = 0;
    for (u32 t = 0; t < n; ++t) live += C->threads[t].state != FINISHED;
    for (u32 b = 0; b < 16; ++b) {
        u32 waiting = 0, wanted = 0;
        bool any = false, all = true;
        u32 count = 0;
        for (u32 t = 0; t < n; ++t) {
            Thread& T = C->threads[t];
            if (T.state != WAITING || T.wait != BARRIER || T.mask != b) continue;
            ++waiting;
            wanted = T.count;
            any |= T.flag != 0;
            all &= T.flag != 0;
            count += T.flag != 0;
            // .aligned: the lanes of a warp come to one and the same instruction
            for (u32 s = t & ~31u; s < t; ++s) {
                Thread& O = C->threads[s];
                if (O.state == WAITING && O.wait == BARRIER && O.mask == b && O.site != T.site) {
                    C->thread = t;
                    C->address = s;
                    fault(C, DIVERGED_BARRIER, T.site);
                }
            }
        }
        if (!waiting) continue;
        const u32 expected = wanted ? wanted : live;
        if (waiting + C->arrived[b] < expected) continue;
        if (waiting + C->arrived[b] > expected) {
            C->address = b;
            fault(C, TOO_MANY_ARRIVED, 0);
        }
        C->arrived[b] = 0;
        for (u32 t = 0; t < n; ++t) {
            Thread& T = C->threads[t];
            if (T.state == WAITING && T.wait == BARRIER && T.mask == b)
                finish(T, count, T.kind == 0 ? all : any);
        }
        return true;
    }
    return false;
}

static void run_block(Context* C)
{
    const u32 n = C->block_dim, warps = (n + 31) / 32;
    for (u32 b = 0; b < 16; ++b) C->arrived[b] = 0;
    for (u32 t = 0; t < n; ++t) C->threads[t].state = READY;
    for (;;) {
        for (u32 k = 0; k < warps; ++k) {
            const u32 w = C->warp_order[k], lanes = n - 32 * w < 32 ? n - 32 * w : 32;
            Thread* W = C->threads + 32 * w;
            do {
                for (u32 i = 0; i < 32; ++i) {
                    const u32 lane = C->lane_order[i];
                    if (lane >= lanes || W[lane].state != READY) continue;
                    C->thread = 32 * w + lane;
                    run_thread(C, C->thread);
                }
            } while (complete_warps(C, W, lanes));
        }
        if (complete_barriers(C)) continue;
        for (u32 t = 0; t < n; ++t)
            if (C->threads[t].state != FINISHED) {
                C->thread = t;
                fault(C, DEADLOCK, C->threads[t].site);
            }
        return;
    }
}
