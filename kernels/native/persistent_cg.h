// Conjugate gradients with the inverses of diagonal blocks as preconditioner, the whole solve in one launch of resident
// thread blocks (CUDA). A team of blocks solves one world after another; each block owns a range of its nodes. The
// scalars of an iteration come from one reduction (Chronopoulos and Gear 1989), so it has two barriers of the team, or
// three with contacts.
// In: count, entries, worlds, per_team, lanes, rows (without blocks), planes, inverses, couplings, most.
// In and out: x, r, scalars, status, added (zero), barriers (zero). Out: iterations. Work: u, p, q, s, parts.
constexpr unsigned ALL = 0xffffffffu;
__shared__ double warp_sums[3][32], totals[3];
const int teams = gridDim.x / per_team, team = blockIdx.x / per_team, member = blockIdx.x % per_team;
const int threads = blockDim.x, thread = threadIdx.x;
const auto four_at = [](const auto& a, long long i) { return reinterpret_cast<float4*>(a.data) + i; };
if (team >= teams) return;
// What one block writes and another reads goes through the second cache: the reader asks for it with __ldcg. So no
// barrier empties the first one, which keeps the matrix.
const auto barrier = [&]() {
    __syncthreads();
    if (per_team > 1 && thread == 0) {
        unsigned* arrived = &barriers.data[32 * team];
        unsigned mine, now;
        asm volatile("atom.release.gpu.global.add.u32 %0, [%1], 1;" : "=r"(mine) : "l"(arrived) : "memory");
        const unsigned goal = (mine / per_team + 1) * per_team;
        do asm volatile("ld.relaxed.gpu.global.u32 %0, [%1];" : "=r"(now) : "l"(arrived) : "memory");
        while (now < goal);
    }
    __syncthreads();
};
// The sums of three numbers over the threads of the team, for all of them.
const auto sum_up = [&](double a, double b, double c) {
    for (int step = 16; step > 0; step /= 2) {
        a += __shfl_xor_sync(ALL, a, step);
        b += __shfl_xor_sync(ALL, b, step);
        c += __shfl_xor_sync(ALL, c, step);
    }
    if (thread % 32 == 0) { warp_sums[0][thread / 32] = a; warp_sums[1][thread / 32] = b; warp_sums[2][thread / 32] = c; }
    __syncthreads();
    if (thread < 3) {
        double total = 0.0;
        for (int k = 0; k < threads / 32; ++k) total += warp_sums[thread][k];
        if (per_team == 1) totals[thread] = total;
        else parts.data[3 * blockIdx.x + thread] = total;
    }
    if (per_team == 1) { __syncthreads(); return; }
    barrier();
    if (thread < 96) {
        const int which = thread / 32;
        double total = 0.0;
        for (int k = thread % 32; k < per_team; k += 32) total += __ldcg(&parts.data[3 * (team * per_team + k) + which]);
        for (int step = 16; step > 0; step /= 2) total += __shfl_xor_sync(ALL, total, step);
        if (thread % 32 == 0) totals[which] = total;
    }
    __syncthreads();
};
const auto times = [](const float* m, const float4& v) {
    return make_float4(m[0] * v.x + m[3] * v.y + m[6] * v.z, m[1] * v.x + m[4] * v.y + m[7] * v.z,
                       m[2] * v.x + m[5] * v.y + m[8] * v.z, 0.0f);
};
const int* starts = rows.starts.data;
const int* columns = rows.columns.data;
const int contacts = min(couplings.count.data[0], couplings.nodes.shape[0]);
const int lo = (long long)count * member / per_team, hi = (long long)count * (member + 1) / per_team;
const int lane = thread % lanes, group = thread / lanes, groups = threads / lanes;
for (int world = team; world < worlds; world += teams) {
    if (status.data[world] != RUNNING) continue;
    const long long first = (long long)world * count;
    // Number c of entry k, at c * entries + k: neighbouring lanes read neighbouring numbers.
    const float* blocks = planes.data + 9ll * world * entries;
    const float* inverse = &inverses.data[first].data[0][0];
    double* sc = &wp::index(scalars, world, 0);
    const float4* given = four_at(u, first);
    for (int i = lo + thread; i < hi; i += threads) {
        *four_at(u, first + i) = times(inverse + 9ll * i, *four_at(r, first + i));
        *four_at(p, first + i) = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        *four_at(s, first + i) = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
    }
    const bool is_last = !(sc[END] > sc[WITHIN] && sc[BEGAN] > SETTLED * SETTLED * sc[WITHIN]);
    const double within = sc[END], end = is_last ? CLOSER * within : within;
    double before = 0.0, alpha = 0.0, square = sc[RR];
    int found = RUNNING, done = 0;
    while (true) {
        barrier();
        if (contacts > 0) {
            for (int c = member * groups + group; c < contacts; c += per_team * groups) {
                const int* node = &wp::index(couplings.nodes, c, 0);
                const float4* part = reinterpret_cast<const float4*>(&wp::index(couplings.parts, c, 0));
                if (node[0] < first || node[0] >= first + count) continue;
                float along = 0.0f;
                for (int k = lane; k < PLACES; k += lanes) {
                    if (node[k] < 0) break;
                    const float4 v = __ldcg(given + (node[k] - first));
                    along += part[k].x * v.x + part[k].y * v.y + part[k].z * v.z;
                }
                const unsigned together = lanes == 32 ? ALL : ((1u << lanes) - 1u) << (thread & 31 & ~(lanes - 1));
                for (int step = lanes / 2; step > 0; step /= 2) along += __shfl_xor_sync(together, along, step);
                for (int k = lane; k < PLACES; k += lanes) {
                    if (node[k] < 0) break;
                    float* to = &added.data[node[k]][0];
                    atomicAdd(to, along * part[k].x);
                    atomicAdd(to + 1, along * part[k].y);
                    atomicAdd(to + 2, along * part[k].z);
                }
            }
            barrier();
        }
        double gamma = 0.0, delta = 0.0, rr = 0.0;
        for (int base = lo; base < hi; base += groups) {
            const int i = base + group;
            float a = 0.0f, b = 0.0f, c = 0.0f;
            if (i < hi) {
                #pragma unroll 4
                for (int k = starts[i] + lane; k < starts[i + 1]; k += lanes) {
                    const float* m = blocks + k;
                    const long long e = entries;
                    const float4 v = __ldcg(given + columns[k]);
                    a += m[0] * v.x + m[3 * e] * v.y + m[6 * e] * v.z;
                    b += m[e] * v.x + m[4 * e] * v.y + m[7 * e] * v.z;
                    c += m[2 * e] * v.x + m[5 * e] * v.y + m[8 * e] * v.z;
                }
            }
            for (int step = lanes / 2; step > 0; step /= 2) {
                a += __shfl_xor_sync(ALL, a, step);
                b += __shfl_xor_sync(ALL, b, step);
                c += __shfl_xor_sync(ALL, c, step);
            }
            if (i < hi && lane == 0) {
                float4 w = make_float4(a, b, c, 0.0f);
                if (contacts > 0) {
                    float4* more = four_at(added, first + i);
                    const float4 v = __ldcg(more);
                    w.x += v.x; w.y += v.y; w.z += v.z;
                    *more = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
                }
                *four_at(q, first + i) = w;
                const float4 v = __ldcg(given + i), rest = *four_at(r, first + i);
                gamma += (double)rest.x * v.x + (double)rest.y * v.y + (double)rest.z * v.z;
                delta += (double)w.x * v.x + (double)w.y * v.y + (double)w.z * v.z;
                rr += (double)rest.x * rest.x + (double)rest.y * rest.y + (double)rest.z * rest.z;
            }
        }
        sum_up(gamma, delta, rr);
        gamma = totals[0]; delta = totals[1]; square = totals[2];
        if (!(square <= 1e300)) found = BROKEN;
        else if (square <= end) found = CONVERGED;
        else if (done >= most) found = LIMIT;
        else if (!(gamma > 0.0)) found = gamma <= 0.0 ? LIMIT : BROKEN;
        if (found != RUNNING) break;
        ++done;
        const double beta = done > 1 ? gamma / before : 0.0;
        const double curvature = done > 1 ? delta - beta * gamma / alpha : delta;
        if (!(curvature > 0.0)) {
            found = curvature <= 0.0 ? NEGATIVE : BROKEN;
            if (done == 1 && found == NEGATIVE)
                for (int i = lo + thread; i < hi; i += threads) {
                    float4* to = four_at(x, first + i);
                    const float4 v = *four_at(u, first + i);
                    *to = make_float4(to->x + v.x, to->y + v.y, to->z + v.z, 0.0f);
                }
            break;
        }
        alpha = gamma / curvature;
        before = gamma;
        const float al = (float)alpha, be = (float)beta;
        for (int i = lo + thread; i < hi; i += threads) {
            const float4 v = *four_at(u, first + i), w = *four_at(q, first + i);
            float4 d = *four_at(p, first + i), e = *four_at(s, first + i), at = *four_at(x, first + i), rest = *four_at(r, first + i);
            d = make_float4(v.x + be * d.x, v.y + be * d.y, v.z + be * d.z, 0.0f);
            e = make_float4(w.x + be * e.x, w.y + be * e.y, w.z + be * e.z, 0.0f);
            at = make_float4(at.x + al * d.x, at.y + al * d.y, at.z + al * d.z, 0.0f);
            rest = make_float4(rest.x - al * e.x, rest.y - al * e.y, rest.z - al * e.z, 0.0f);
            *four_at(p, first + i) = d;
            *four_at(s, first + i) = e;
            *four_at(x, first + i) = at;
            *four_at(r, first + i) = rest;
            *four_at(u, first + i) = times(inverse + 9ll * i, rest);
        }
    }
    // Next to rounding, nothing is left that iterations could take away, and products may look negative.
    if (square <= within && !(found == NEGATIVE && done == 1)) found = CONVERGED;
    barrier();
    if (member == 0 && thread == 0) {
        sc[RR] = square;
        status.data[world] = found;
        iterations.data[world] = done;
    }
}
