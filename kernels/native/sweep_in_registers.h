// Symmetric sweeps over a world's matrix by a block of threads on CUDA, which keep it in registers.
// In: world. In and out: matrix, float64, of at most TILE * TILES rows; only its lower triangle counts.
#if defined(__CUDA_ARCH__)
constexpr int TILE = 8, TILES = 24;
// The pivot's row; threads may still read that of the last sweep.
__shared__ double rows[2][TILES * TILE];
const int n = matrix.shape[1];
double* const m = &wp::index(matrix, world, 0, 0);
int row_tile = 0, column_tile = threadIdx.x;
while (column_tile > row_tile) column_tile -= ++row_tile;
const bool has_tile = row_tile < TILES;
const int i0 = TILE * row_tile, j0 = TILE * column_tile;
double a[TILE][TILE];
if (has_tile) {
    #pragma unroll
    for (int r = 0; r < TILE; ++r)
        #pragma unroll
        for (int c = 0; c < TILE; ++c) {
            const int i = max(i0 + r, j0 + c), j = min(i0 + r, j0 + c);
            a[r][c] = i < n ? m[i * n + j] : 0.0;
        }
}
for (int pivot_tile = 0; TILE * pivot_tile < n; ++pivot_tile) {
    #pragma unroll
    for (int p = 0; p < TILE; ++p) {
        const int k = TILE * pivot_tile + p;
        if (k >= n) break;
        double* const row = rows[p & 1];
        if (has_tile && row_tile == pivot_tile) {
            #pragma unroll
            for (int c = 0; c < TILE; ++c) row[j0 + c] = a[p][c];
        } else if (has_tile && column_tile == pivot_tile) {
            #pragma unroll
            for (int r = 0; r < TILE; ++r) row[i0 + r] = a[r][p];
        }
        __syncthreads();
        if (has_tile) {
            const double inverse = 1.0 / row[k];
            double factor[TILE], value[TILE];
            #pragma unroll
            for (int r = 0; r < TILE; ++r) factor[r] = row[i0 + r] * inverse;
            #pragma unroll
            for (int c = 0; c < TILE; ++c) value[c] = row[j0 + c];
            #pragma unroll
            for (int r = 0; r < TILE; ++r)
                #pragma unroll
                for (int c = 0; c < TILE; ++c) a[r][c] -= factor[r] * value[c];
            if (row_tile == pivot_tile) {
                #pragma unroll
                for (int c = 0; c < TILE; ++c) a[p][c] = value[c] * inverse;
            }
            if (column_tile == pivot_tile) {
                #pragma unroll
                for (int r = 0; r < TILE; ++r) a[r][p] = factor[r];
            }
            if (row_tile == pivot_tile && column_tile == pivot_tile) a[p][p] = -inverse;
        }
    }
}
if (has_tile) {
    #pragma unroll
    for (int r = 0; r < TILE; ++r)
        #pragma unroll
        for (int c = 0; c < TILE; ++c)
            if (i0 + r < n && j0 + c <= i0 + r) m[(i0 + r) * n + j0 + c] = a[r][c];
}
#endif
