// Conjugate gradients for one world by one thread, preconditioned by a symmetric sweep (SSOR) over block rows.
//
// The matrix with contacts is A; L and U are the parts of its rows below and above the diagonal, without contacts, and
// P is its diagonal with them. With M = (P + L) P^-1 (P + U) the iteration runs in (P + L)^-1 r, so that a product and its preconditioner together read each block
// once (Eisenstat 1981): with t = (P + U)^-1 p, (P + L)^-1 A t = t + (P + L)^-1 (p + (A - L - U - 2 P) t).
// In: world, count, entries, rows, diagonal, inverses, pivots, couplings, most.
// In and out: x, r, scalars, status. Out: iterations. Work: u, p, q, s.
typedef float four __attribute__((vector_size(16), aligned(4)));
const int* starts = rows.starts.data;
const int* columns = rows.columns.data;
const int* own = diagonal.data;
const long long first = (long long)world * count;
const float* blocks = &rows.blocks.data[(long long)world * entries].data[0][0];
const float* inverse = &inverses.data[first].data[0][0];
const float* pivot = &pivots.data[first].data[0][0];
const auto at = [&](const auto& a) { return reinterpret_cast<four*>(a.data) + first; };
four *solution = at(x), *rest = at(r), *half = at(u), *direction = at(p), *image = at(q), *turned = at(s);
double* numbers = &wp::index(scalars, world, 0);
// Blocks are transposed; of the last column a number past its end is read.
const auto times = [](const float* m, const four& v) {
    four a = *reinterpret_cast<const four*>(m) * v[0] + *reinterpret_cast<const four*>(m + 3) * v[1];
    a += *reinterpret_cast<const four*>(m + 6) * v[2];
    return four{a[0], a[1], a[2], 0.0f};
};
const auto sum = [&](const four* v, int begin, int end) {
    four a = {0.0f, 0.0f, 0.0f, 0.0f}, b = a, c = a;
    const float* m = blocks + 9ll * begin;
    for (int k = begin; k < end; ++k, m += 9) {
        const four u = v[columns[k]];
        a += *reinterpret_cast<const four*>(m) * u[0];
        b += *reinterpret_cast<const four*>(m + 3) * u[1];
        c += *reinterpret_cast<const four*>(m + 6) * u[2];
    }
    a += b + c;
    return four{a[0], a[1], a[2], 0.0f};
};
// In double precision, as squares of what is nearly at rest are less than any float.
const auto dot = [](const four& a, const four& b) {
    return (double)a[0] * b[0] + (double)a[1] * b[1] + (double)a[2] * b[2];
};
// (P + L)^-1 of v
const auto forward = [&](const four* v, four* to) {
    for (int i = 0; i < count; ++i) to[i] = times(inverse + 9ll * i, v[i] - sum(to, starts[i], own[i]));
};
// |(P + L) half|^2, the residual's
const auto residual = [&]() {
    double total = 0.0;
    for (int i = 0; i < count; ++i) {
        four v = sum(half, starts[i], own[i]);
        if (couplings.projected.data[first + i]) v = times(&couplings.projectors.data[first + i].data[0][0], v);
        v += times(pivot + 9ll * i, half[i]);
        total += dot(v, v);
    }
    return total;
};
if (status.data[world] != RUNNING) return;
const bool is_last = !(numbers[END] > numbers[WITHIN] && numbers[BEGAN] > SETTLED * SETTLED * numbers[WITHIN]);
const double end = is_last ? CLOSER * numbers[END] : numbers[END];
forward(rest, half);
double product = 0.0, now = numbers[RR];
for (int i = 0; i < count; ++i) {
    direction[i] = times(pivot + 9ll * i, half[i]);
    product += dot(half[i], direction[i]);
}
int found = RUNNING, done = 0;
if (!(product > 0.0)) found = BROKEN;
while (found == RUNNING) {
    ++done;
    for (int i = count - 1; i >= 0; --i)
        turned[i] = times(inverse + 9ll * i, direction[i] - sum(turned, own[i] + 1, starts[i + 1]));
    for (int i = 0; i < count; ++i)
        image[i] = direction[i] + times(blocks + 9ll * own[i], turned[i]) - times(pivot + 9ll * i, turned[i]) * 2.0f;
    const int contacts = couplings.count.data[0] < couplings.nodes.shape[0] ? couplings.count.data[0] : couplings.nodes.shape[0];
    for (int c = 0; c < contacts; ++c) {
        const int* node = &wp::index(couplings.nodes, c, 0);
        const four* part = reinterpret_cast<const four*>(&wp::index(couplings.parts, c, 0));
        if (node[0] < first || node[0] >= first + count) continue;
        four along = {0.0f, 0.0f, 0.0f, 0.0f};
        for (int k = 0; k < PLACES && node[k] >= 0; ++k) along += part[k] * turned[node[k] - first];
        const float size = along[0] + along[1] + along[2];
        for (int k = 0; k < PLACES && node[k] >= 0; ++k) image[node[k] - first] += part[k] * size;
    }
    double curvature = 0.0;
    for (int i = 0; i < count; ++i) {
        image[i] = times(inverse + 9ll * i, image[i] - sum(image, starts[i], own[i]));
        // What follows needs the sum; the sweep needs this part alone.
        curvature += dot(direction[i], image[i] + turned[i]);
    }
    if (!(curvature > 0.0)) {
        found = curvature <= 0.0 ? NEGATIVE : BROKEN;
        if (done == 1 && found == NEGATIVE)
            for (int i = 0; i < count; ++i) solution[i] += turned[i];
        break;
    }
    const float alpha = (float)(product / curvature);
    double after = 0.0;
    for (int i = 0; i < count; ++i) {
        solution[i] += turned[i] * alpha;
        half[i] -= (image[i] + turned[i]) * alpha;
        after += dot(half[i], times(pivot + 9ll * i, half[i]));
    }
    // The residual's own norm costs half a product, so it is asked for rarely until the end is near.
    if (done % 4 == 0 || done >= most || !(after > 0.0)) {
        now = residual();
        if (!(now <= 1e300)) found = BROKEN;
        else if (now <= end) found = CONVERGED;
        else if (done >= most) found = now <= numbers[END] ? CONVERGED : LIMIT;
    }
    const float beta = (float)(after / product);
    for (int i = 0; i < count; ++i)
        direction[i] = times(pivot + 9ll * i, half[i]) + direction[i] * beta;
    product = after;
}
numbers[RR] = now;
status.data[world] = found;
iterations.data[world] = done;
