// Symmetric sweeps over a world's matrix by one thread.
// In: world. In and out: matrix, float64; only its lower triangle counts. Out: rows, where the pivot's row is kept.
const int n = matrix.shape[1];
double* const m = &wp::index(matrix, world, 0, 0);
double* const row = &wp::index(rows, world, 0);
for (int k = 0; k < n; ++k) {
    for (int j = 0; j < n; ++j) row[j] = j < k ? m[k * n + j] : j > k ? m[j * n + k] : 0.0;
    const double inverse = 1.0 / m[k * n + k];
    for (int i = 0; i < n; ++i) {
        double* const a = m + i * n;
        const double factor = row[i] * inverse;
        if (i != k)
            for (int j = 0; j <= i; ++j) a[j] -= factor * row[j];
        if (i > k) a[k] = factor;
    }
    for (int j = 0; j < k; ++j) m[k * n + j] = row[j] * inverse;
    m[k * n + k] = -inverse;
}
