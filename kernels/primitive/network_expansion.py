"""The second-order expansion of a network at a point: phi, its gradient and its Hessian.

Phi is computed in double precision: next to silhouettes it is far smaller than the rounding of float32
(``network.py``), and moving rays follow it down (``boundary/signed_distance/march.py``). The Hessian is a sum over all
activations: the change of phi by the activation's value, times its second derivative, times the square of the gradient
of its argument. One sweep forwards with three rates and one back compute it.

Derivation: ``docs/theory/signed_distances.md#networks``.
"""

import warp as wp

from warp_psdr.kernels.primitive.network import network_text

#: Phi, its gradient, and its second derivatives xx, yy, zz, yz, xz, xy.
EXPANSION = wp.types.vector(length=10, dtype=wp.float32)

SOURCE = """
#if !defined(__CUDACC__)
    typedef float row __attribute__((ext_vector_type($BLOCK), aligned(4), may_alias));
    typedef double wide_row __attribute__((ext_vector_type($BLOCK), aligned(8), may_alias));
#endif
    const float* head = values.data + place;
    const int layers = (int)head[1], frequencies = (int)head[2], sine = (int)head[3];
    const float scale = head[4];
    const float* packed = head + (int)head[5];
    const float* widths = head + 7;
    // What a layer takes and gives, and the gradient of what it takes.
    double a[$WIDTH], c[$WIDTH];
    float rates[3][$WIDTH];
    // Of each layer the gradients of its arguments, and the activation's derivatives there.
    float gradients[$LAYERS][3][$WIDTH], first[$LAYERS][$WIDTH], second[$LAYERS][$WIDTH];
    // Derivatives of what the first layer takes, each a function of one coordinate.
    float turns[$WIDTH], bends[$WIDTH];
    for (int j = 0; j < 3 + 6 * frequencies; ++j) {
        const int k = (j - 3) / 6, i = j % 3;
        a[j] = q[i];
        turns[j] = 1.0f;
        bends[j] = 0.0f;
        if (j >= 3) {
            const double turn = 3.141592653589793 * (double)(1 << k), s = ::sin(turn * q[i]), b = ::cos(turn * q[i]);
            const bool sine_here = (j - 3) % 6 < 3;
            a[j] = sine_here ? s : b;
            turns[j] = (float)(sine_here ? turn * b : -turn * s);
            bends[j] = (float)(-turn * turn * a[j]);
        }
        for (int m = 0; m < 3; ++m)
            rates[m][j] = m == i ? turns[j] : 0.0f;
    }
    int size = 0;
    for (int l = 0; l < layers - 1; l += 1) {
        const int in = (int)widths[l], out = (int)widths[l + 1];
        for (int i = 0; i < out; i += $BLOCK) {
#if defined(__CUDACC__)
            for (int k = 0; k < $BLOCK; ++k) {
                double s = packed[k];
                float t[3] = {0.0f, 0.0f, 0.0f};
                for (int j = 0; j < in; ++j) {
                    const float weight = packed[(j + 1) * $BLOCK + k];
                    s += weight * a[j];
                    for (int m = 0; m < 3; ++m)
                        t[m] += weight * rates[m][j];
                }
                c[i + k] = s;
                for (int m = 0; m < 3; ++m)
                    gradients[l][m][i + k] = t[m];
            }
#else
            wide_row s = __builtin_convertvector(*(const row*)packed, wide_row);
            row t0 = 0.0f, t1 = 0.0f, t2 = 0.0f;
            for (int j = 0; j < in; ++j) {
                const row r = *(const row*)(packed + (j + 1) * $BLOCK);
                s += __builtin_convertvector(r, wide_row) * a[j];
                t0 += r * rates[0][j];
                t1 += r * rates[1][j];
                t2 += r * rates[2][j];
            }
            *(wide_row*)(c + i) = s;
            *(row*)(gradients[l][0] + i) = t0;
            *(row*)(gradients[l][1] + i) = t1;
            *(row*)(gradients[l][2] + i) = t2;
#endif
            packed += (in + 1) * $BLOCK;
        }
        for (int k = 0; k < out; ++k) {
            const double z = (double)scale * c[k];
            if (sine) {
                a[k] = ::sin(z);
                first[l][k] = scale * (float)::cos(z);
                second[l][k] = -scale * scale * (float)a[k];
            } else {
                const double e = ::exp(z < 0.0 ? z : -z);
                const float share = (float)(1.0 / (1.0 + e));
                a[k] = (c[k] > 0.0 ? c[k] : 0.0) + ::log(1.0 + e) / (double)scale;
                first[l][k] = c[k] > 0.0 ? share : (float)e * share;
                second[l][k] = scale * (float)e * share * share;
            }
            for (int m = 0; m < 3; ++m)
                rates[m][k] = first[l][k] * gradients[l][m][k];
        }
        size += out * (in + 1);
    }
    double phi = packed[0];
    float down[$WIDTH], sums[$WIDTH];
    for (int j = 0; j < (int)widths[layers - 1]; ++j) {
        phi += packed[j + 1] * a[j];
        down[j] = packed[j + 1];
    }
    float g[3] = {0.0f, 0.0f, 0.0f}, h[6] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
    for (int l = layers - 2; l >= 0; --l) {
        const int in = (int)widths[l], out = (int)widths[l + 1];
        size -= out * (in + 1);
        const float* rows = head + $HEADER + size;
        for (int j = 0; j < in; ++j)
            sums[j] = 0.0f;
        for (int i = 0; i < out; ++i) {
            const float bend = down[i] * second[l][i], slope = down[i] * first[l][i];
            const float x0 = gradients[l][0][i], x1 = gradients[l][1][i], x2 = gradients[l][2][i];
            h[0] += bend * x0 * x0;
            h[1] += bend * x1 * x1;
            h[2] += bend * x2 * x2;
            h[3] += bend * x1 * x2;
            h[4] += bend * x0 * x2;
            h[5] += bend * x0 * x1;
            const float* weights = rows + i * in;
            for (int j = 0; j < in; ++j)
                sums[j] += weights[j] * slope;
        }
        for (int j = 0; j < in; ++j)
            down[j] = sums[j];
    }
    for (int j = 0; j < 3 + 6 * frequencies; ++j) {
        g[j % 3] += down[j] * turns[j];
        h[j % 3] += down[j] * bends[j];
    }
    wp::vec_t<10, wp::float32> expansion;
    expansion[0] = (float)phi;
    for (int i = 0; i < 3; ++i)
        expansion[1 + i] = g[i];
    for (int i = 0; i < 6; ++i)
        expansion[4 + i] = h[i];
    return expansion;
"""


@wp.func_native(network_text(SOURCE))
def network_expansion(values: wp.array(dtype=wp.float32), place: wp.int32, q: wp.vec3d) -> EXPANSION:
    """Phi and its derivatives at a point of the box; ``place`` is that of the head."""
    return EXPANSION()
