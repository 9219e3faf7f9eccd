"""C++ source of the functions of a network; see ``network.py``.

All loops that count are over blocks of $BLOCK numbers, which compilers turn into SIMD. A layer is a product of the
packed weights, $BLOCK rows at a time, with the input numbers and their rates along one direction. ``float(x)`` is a
macro in Warp's CPU compiler: write ``(float)x``.
"""

# Rows of ``first`` are derivatives of the activation by its argument, of ``second`` the second ones times the rate.
TYPES = """
#if defined(__CUDACC__)
    typedef float row;
    typedef int int_row;
#define CONVERT(x, type) ((type)(x))
#define WHERE(x, a, b) ((x) ? (a) : (b))
#define STEP 1
#define BITS(x) __int_as_float(x)
#define FIRST(x) (x)
#else
    typedef float row __attribute__((ext_vector_type($BLOCK), aligned(4), may_alias));
    typedef int int_row __attribute__((ext_vector_type($BLOCK), aligned(4), may_alias));
#define CONVERT(x, type) __builtin_convertvector(x, type)
#define WHERE(x, a, b) ((x) ? row(a) : row(b))
#define STEP $BLOCK
#define BITS(x) __builtin_bit_cast(row, x)
#define FIRST(x) (x)[0]
#endif
    struct Net {
        // exp(x) of x <= 0; not less than 4e-18, so that nothing is denormal.
        static inline row exponential(row x) {
            x = WHERE(x < -40.0f, -40.0f, x);
            const int_row n = CONVERT(x * 1.44269504f - 0.5f, int_row);
            const row r = (x - CONVERT(n, row) * 0.693359375f) + CONVERT(n, row) * 2.12194440e-4f;
            row p = r * 1.9875691500e-4f + 1.3981999507e-3f;
            p = p * r + 8.3334519073e-3f;
            p = p * r + 4.1665795894e-2f;
            p = p * r + 1.6666665459e-1f;
            p = p * r + 5.0000001201e-1f;
            const int_row bits = (n + 127) << 23;
            return (p * r * r + r + 1.0f) * BITS(bits);
        }
        // log(1 + x) of x in [0, 1].
        static inline row logarithm(row x) {
            const row u = x / (2.0f + x), w = u * u;
            row p = w * 0.153846154f + 0.181818182f;
            p = p * w + 0.222222222f;
            p = p * w + 0.285714286f;
            p = p * w + 0.4f;
            p = p * w + 0.666666667f;
            return u * (p * w + 2.0f);
        }
        // Sine and cosine of n pi + r, |r| <= pi / 2.
        static inline row sine_of(row r) {
            const row w = r * r;
            row s = w * -2.38889859e-8f + 2.75256240e-6f;
            s = s * w - 1.98408743e-4f;
            s = s * w + 8.33333030e-3f;
            s = s * w - 1.66666666e-1f;
            return s * w * r + r;
        }
        static inline row cosine_of(row r) {
            const row w = r * r;
            row c = w * 2.06054492e-9f - 2.75556961e-7f;
            c = c * w + 2.48015795e-5f;
            c = c * w - 1.38888884e-3f;
            c = c * w + 4.16666666e-2f;
            c = c * w - 0.5f;
            return c * w + 1.0f;
        }
        // Sine and cosine of 2^k pi x.
        static inline void turn(float x, int k, float* sine, float* cosine) {
            const float t = x * (float)(1 << k);
            const int n = (int)(t + (t < 0.0f ? -0.5f : 0.5f));
            const float r = 3.14159265f * (t - (float)n), sign = (n & 1) ? -1.0f : 1.0f;
            *sine = sign * FIRST(sine_of(row(r)));
            *cosine = sign * FIRST(cosine_of(row(r)));
        }
        static inline void encode(const float* x, const float* v, int frequencies, float* a, float* b) {
            for (int i = 0; i < 3; ++i) {
                a[i] = x[i];
                b[i] = v[i];
            }
            for (int k = 0; k < frequencies; ++k)
                for (int i = 0; i < 3; ++i) {
                    float s, c;
                    turn(x[i], k, &s, &c);
                    const float rate = 3.14159265f * (float)(1 << k) * v[i];
                    a[6 * k + 3 + i] = s;
                    a[6 * k + 6 + i] = c;
                    b[6 * k + 3 + i] = rate * c;
                    b[6 * k + 6 + i] = -rate * s;
                }
        }
        // c = W a + bias, d = W b; the number of the next layer's packed weights.
        static inline const float* layer(const float* w, int in, int out, const float* a, const float* b, float* c,
                                         float* d) {
            for (int i = 0; i < out; i += $BLOCK) {
#if defined(__CUDACC__)
                float s[$BLOCK], t[$BLOCK];
                for (int k = 0; k < $BLOCK; ++k) {
                    s[k] = w[k];
                    t[k] = 0.0f;
                }
                w += $BLOCK;
                for (int j = 0; j < in; ++j) {
                    for (int k = 0; k < $BLOCK; ++k) {
                        s[k] += w[k] * a[j];
                        t[k] += w[k] * b[j];
                    }
                    w += $BLOCK;
                }
                for (int k = 0; k < $BLOCK; ++k) {
                    c[i + k] = s[k];
                    d[i + k] = t[k];
                }
#else
                row s = *(const row*)w, t = 0.0f;
                w += $BLOCK;
                for (int j = 0; j < in; ++j) {
                    const row r = *(const row*)w;
                    s += r * a[j];
                    t += r * b[j];
                    w += $BLOCK;
                }
                *(row*)(c + i) = s;
                *(row*)(d + i) = t;
#endif
            }
            return w;
        }
        // The activation of c and its rate, in place.
        static inline void activate(int sine, float scale, int count, float* c, float* d, float* first,
                                    float* second) {
            const float over = 1.0f / scale;
            for (int k = 0; k < count; k += STEP) {
                row& value = *(row*)(c + k);
                row& rate = *(row*)(d + k);
                if (sine) {
                    const row z = scale * value, t = z * 0.318309886f;
                    const int_row n = CONVERT(t + WHERE(t < 0.0f, -0.5f, 0.5f), int_row);
                    const row r = (z - CONVERT(n, row) * 3.140625f) - CONVERT(n, row) * 9.67653590e-4f;
                    const row sign = WHERE((n & 1) != 0, -1.0f, 1.0f);
                    value = sign * sine_of(r);
                    *(row*)(second + k) = (-scale * scale) * value * rate;
                    const row slope = scale * sign * cosine_of(r);
                    *(row*)(first + k) = slope;
                    rate = slope * rate;
                } else {
                    const row z = value;
                    const row e = exponential(WHERE(z < 0.0f, scale * z, -scale * z));
                    const row share = 1.0f / (1.0f + e), slope = WHERE(z > 0.0f, share, e * share);
                    value = WHERE(z > 0.0f, z, 0.0f) + over * logarithm(e);
                    *(row*)(second + k) = scale * e * share * share * rate;
                    *(row*)(first + k) = slope;
                    rate = slope * rate;
                }
            }
        }
    };
    const float* head = values.data + place;
    const float x[3] = {q[0], q[1], q[2]}, v[3] = {w[0], w[1], w[2]};
    const int layers = (int)head[1], frequencies = (int)head[2], sine = (int)head[3];
    const float scale = head[4];
    const float* packed = head + (int)head[5];
    const float* widths = head + 7;
"""

# phi and its derivative along w.
ALONG = """
    float a[$WIDTH], b[$WIDTH], c[$WIDTH], d[$WIDTH], first[$WIDTH], second[$WIDTH];
    Net::encode(x, v, frequencies, a, b);
    for (int l = 0; l < layers - 1; l += 1) {
        const int in = (int)widths[l], out = (int)widths[l + 1];
        packed = Net::layer(packed, in, out, a, b, c, d);
        const int count = (out + $BLOCK - 1) / $BLOCK * $BLOCK;
        Net::activate(sine, scale, count, c, d, first, second);
        for (int k = 0; k < count; ++k) {
            a[k] = c[k];
            b[k] = d[k];
        }
    }
    const int last = (int)widths[layers - 1];
    float phi = packed[0], rate = 0.0f;
    for (int j = 0; j < last; ++j) {
        phi += packed[j + 1] * a[j];
        rate += packed[j + 1] * b[j];
    }
    return wp::vec2(phi, rate);
"""

# Of L = a_phi phi + (phi's derivative along w): its derivative by q, and phi; $SINK what a weight gets.
PULL = """
    float a[$LAYERS][$WIDTH], b[$LAYERS][$WIDTH], first[$LAYERS][$WIDTH], second[$LAYERS][$WIDTH];
    Net::encode(x, v, frequencies, a[0], b[0]);
    for (int l = 0; l < layers - 1; l += 1) {
        const int in = (int)widths[l], out = (int)widths[l + 1];
        packed = Net::layer(packed, in, out, a[l], b[l], a[l + 1], b[l + 1]);
        const int count = (out + $BLOCK - 1) / $BLOCK * $BLOCK;
        Net::activate(sine, scale, count, a[l + 1], b[l + 1], first[l], second[l]);
    }
    int size = 0;
    for (int l = 0; l < layers; ++l)
        size += (int)widths[l + 1] * ((int)widths[l] + 1);
    // Adjoints of a layer's results and of their rates.
    float za[$WIDTH], zb[$WIDTH], pa[$WIDTH], pb[$WIDTH];
    za[0] = a_phi;
    zb[0] = 1.0f;
    float phi = packed[0];
    for (int j = 0; j < (int)widths[layers - 1]; ++j)
        phi += packed[j + 1] * a[layers - 1][j];
    $START
    for (int l = layers - 1; l >= 0; --l) {
        const int in = (int)widths[l], out = (int)widths[l + 1];
        size -= out * (in + 1);
        const float* rows = head + $HEADER + size;
        for (int j = 0; j < in; ++j) {
            pa[j] = 0.0f;
            pb[j] = 0.0f;
        }
        for (int i = 0; i < out; ++i) {
            const float p = za[i], r = zb[i];
            const float* row = rows + i * in;
            for (int j = 0; j < in; ++j) {
                pa[j] += row[j] * p;
                pb[j] += row[j] * r;
            }
            $SINK
        }
        if (l > 0)
            for (int j = 0; j < in; ++j) {
                za[j] = first[l - 1][j] * pa[j] + second[l - 1][j] * pb[j];
                zb[j] = first[l - 1][j] * pb[j];
            }
    }
    float g[3];
    for (int i = 0; i < 3; ++i) {
        g[i] = pa[i];
        for (int k = 0; k < frequencies; ++k) {
            const int s = 6 * k + 3 + i, c = s + 3;
            const float turn = 3.14159265f * (float)(1 << k);
            g[i] += turn * (pa[s] * a[0][c] - pa[c] * a[0][s]);
            g[i] -= turn * turn * v[i] * (pb[s] * a[0][s] + pb[c] * a[0][c]);
        }
    }
"""

RETURN_PULL = """
    return wp::vec4(g[0], g[1], g[2], phi);
"""

# The offset of the values of row i of layer l, whose ``in`` weights have the adjoints za[i] a + zb[i] b.
SINKS = {
    "": ("", "", RETURN_PULL),
    "samples": ("", "", "return 0.0f;"),
    "forward": (
        "float total = 0.0f; const float* rates = target.data + place;",
        """
            const float* moved = rates + $HEADER + size + i * in;
            for (int j = 0; j < in; ++j)
                total += moved[j] * (p * a[l][j] + r * b[l][j]);
            total += rates[$HEADER + size + out * in + i] * p;
        """,
        "return total;",
    ),
    "reverse": (
        "float lost = 0.0f; double* sums = (double*)target.data + place;",
        """
            double* moved = sums + $HEADER + size + i * in;
            for (int j = 0; j <= in; ++j) {
                const float value = j < in ? p * a[l][j] + r * b[l][j] : p;
                double* sum = j < in ? moved + j : sums + $HEADER + size + out * in + i;
                if (!(value <= 3.0e38f && value >= -3.0e38f)) {
                    lost += 1.0f;
                    continue;
                }
        #if defined(__CUDA_ARCH__)
                atomicAdd(sum, (double)value);
        #else
                *sum += (double)value;
        #endif
            }
        """,
        "return lost;",
    ),
}
