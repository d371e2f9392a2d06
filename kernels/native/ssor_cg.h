// Conjugate gradients for all worlds, preconditioned by a symmetric sweep (SSOR) over block rows. Threads share the rows
// of a world, or the worlds if there are at least as many.
//
// The matrix is A = L + P + U + C: its parts below, on and above the diagonal, all with contacts, except for what C couples
// of them: rows that two threads sweep over at the same time, and what the list of contacts' entries has no room for. With
// M = (P + L) P^-1 (P + U) the iteration runs in (P + L)^-1 r, so that a product and its preconditioner together read each
// block once (Eisenstat 1981): with t = (P + U)^-1 p, (P + L)^-1 A t = t + (P + L)^-1 (p + (C - P) t).
//
// Rows stand level after level, and in each part after part; those of a level are coupled with no other part's of the
// same level. So threads sweep over the parts of a level side by side, level after level.
// In: team.h; team, per_team, the number of parts; worlds, count, entries, rows, diagonal, division, inverses, pivots,
// couplings, of_contacts, most. In and out: x, r, by node; scalars, status. Out: iterations. Work: u, p, q, s; parts, sums of parts.
const int* starts = rows.starts.data;
const int* columns = rows.columns.data;
const int* own = diagonal.data;
const int *node_of = division.nodes.data, *row_of = division.rows.data;
const bool shares_rows = worlds < per_team;
const int levels = shares_rows ? division.spans.shape[0] / per_team : 1, pieces = shares_rows ? division.spans.shape[1] : 1;
const auto span_of = [&](int level, int part, int piece) {
    return shares_rows ? division.spans.data[(per_team * level + part) * pieces + piece] : wp::vec2i(0, count);
};
const auto in_parts = [&](const auto& work) {
    if (shares_rows) share_work(team, per_team, work);
    else work(0);
};
const auto solve_world = [&](int world) {
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
// The same with contacts: below the diagonal, and above it. Where levels have several pieces, rows are not swept over in
// the order of their numbers.
const auto comes_after = [&](int column, int i) {
    const int* span = division.spans_of.data;
    const int difference = shares_rows ? span[column] / per_team - span[i] / per_team : 0;
    return difference == 0 ? column > i : difference > 0;
};
const int* heads = &of_contacts.heads.data[first];
const bool touches = of_contacts.count.data[0] > 0;
const auto with_contacts = [&](four a, const four* v, int i, bool is_above) {
    for (int e = touches ? heads[i] : -1; e >= 0; e = of_contacts.next.data[e]) {
        const int column = of_contacts.columns.data[e];
        if (comes_after(column, i) == is_above) a += times(&of_contacts.blocks.data[e].data[0][0], v[column]);
    }
    return a;
};
const auto below = [&](const four* v, int i) { return with_contacts(sum(v, starts[i], own[i]), v, i, false); };
const auto above = [&](const four* v, int i) { return with_contacts(sum(v, own[i] + 1, starts[i + 1]), v, i, true); };
// In double precision, as squares of what is nearly at rest are less than any float.
const auto dot = [](const four& a, const four& b) {
    return (double)a[0] * b[0] + (double)a[1] * b[1] + (double)a[2] * b[2];
};
// These call ``work`` with rows and return the sum of what it returns, part by part: with all; with one level after
// another, in which a row may read what earlier ones have got; and the same backwards.
double* sums = parts.data + (shares_rows ? 0 : LINE * world);
const auto total = [&]() {
    double found = 0.0;
    for (int part = 0; part < (shares_rows ? per_team : 1); ++part) found += sums[LINE * part];
    return found;
};
const auto for_rows = [&](const auto& work) {
    in_parts([&](int part) {
        double found = 0.0;
        for (int level = 0; level < levels; ++level)
            for (int piece = 0; piece < pieces; ++piece) {
                const auto span = span_of(level, part, piece);
                for (int i = span[0]; i < span[1]; ++i) found += work(i);
            }
        sums[LINE * part] = found;
    });
    return total();
};
const auto sweep = [&](const auto& work) {
    for (int level = 0; level < levels; ++level)
        in_parts([&](int part) {
            double found = level > 0 ? sums[LINE * part] : 0.0;
            for (int piece = 0; piece < pieces; ++piece) {
                const auto span = span_of(level, part, piece);
                for (int i = span[0]; i < span[1]; ++i) found += work(i);
            }
            sums[LINE * part] = found;
        });
    return total();
};
const auto sweep_back = [&](const auto& work) {
    for (int level = levels - 1; level >= 0; --level)
        in_parts([&](int part) {
            for (int piece = pieces - 1; piece >= 0; --piece) {
                const auto span = span_of(level, part, piece);
                for (int i = span[1] - 1; i >= span[0]; --i) work(i);
            }
        });
};
// |(P + L) half|^2, the residual's
const auto residual = [&]() {
    return for_rows([&](int i) {
        four v = below(half, i);
        v += times(pivot + 9ll * i, half[i]);
        return dot(v, v);
    });
};
if (status.data[world] != RUNNING) return;
const bool is_last = !(numbers[END] > numbers[WITHIN] && numbers[BEGAN] > SETTLED * SETTLED * numbers[WITHIN]);
const double end = is_last ? CLOSER_SWEPT * numbers[END] : numbers[END];
double now = numbers[RR];
float beta = 0.0f;
sweep([&](int i) {
    half[i] = times(inverse + 9ll * i, rest[node_of[i]] - below(half, i));
    return 0.0;
});
double product = for_rows([&](int i) { return dot(half[i], times(pivot + 9ll * i, half[i])); });
const int beside = of_contacts.beside_count.data[0];
double goal = product * end / now;
int found = RUNNING, done = 0, asked = 0;
if (!(product > 0.0)) found = product <= 0.0 ? LIMIT : BROKEN;
while (found == RUNNING) {
    ++done;
    sweep_back([&](int i) {
        four along = times(pivot + 9ll * i, half[i]);
        if (done > 1) along += direction[i] * beta;
        const four t = times(inverse + 9ll * i, along - above(turned, i));
        direction[i] = along;
        turned[i] = t;
        image[i] = along - times(pivot + 9ll * i, t);
    });
    if (beside > 0) in_parts([&](int part) {
        for (int c = 0; c < beside; ++c) {
            const int k = of_contacts.beside.data[c];
            const int* node = &wp::index(couplings.nodes, k, 0);
            const four* weight = reinterpret_cast<const four*>(&wp::index(couplings.parts, k, 0));
            if (node[0] < first || node[0] >= first + count) continue;
            four along = {0.0f, 0.0f, 0.0f, 0.0f};
            for (int j = 0; j < PLACES && node[j] >= 0; ++j) along += weight[j] * turned[row_of[node[j] - first]];
            for (int j = 0; j < PLACES && node[j] >= 0; ++j) {
                const int row = row_of[node[j] - first];
                if (shares_rows && division.spans_of.data[row] % per_team != part) continue;
                const four others = along - weight[j] * turned[row];
                image[row] += weight[j] * (others[0] + others[1] + others[2]);
            }
        }
    });
    const double curvature = sweep([&](int i) {
        image[i] = times(inverse + 9ll * i, image[i] - below(image, i));
        // What follows needs the sum; the sweep needs this part alone.
        return dot(direction[i], image[i] + turned[i]);
    });
    if (!(curvature > 0.0)) {
        found = curvature <= 0.0 ? NEGATIVE : BROKEN;
        if (done == 1 && found == NEGATIVE)
            for_rows([&](int i) {
                solution[node_of[i]] += turned[i];
                return 0.0;
            });
        break;
    }
    const float alpha = (float)(product / curvature);
    const double after = for_rows([&](int i) {
        solution[node_of[i]] += turned[i] * alpha;
        half[i] -= (image[i] + turned[i]) * alpha;
        return dot(half[i], times(pivot + 9ll * i, half[i]));
    });
    // The residual's own norm costs half a product, so it is asked for where the preconditioned one says that it will do.
    if (after <= goal || done - asked >= RARELY || done >= most || !(after > 0.0)) {
        now = residual();
        goal = after * end / now;
        asked = done;
        if (!(now <= 1e300)) found = BROKEN;
        else if (now <= end) found = CONVERGED;
        else if (done >= most || after <= 0.0) found = LIMIT;
    }
    beta = (float)(after / product);
    product = after;
}
// Next to rounding, nothing is left that iterations could take away, and products may look negative.
if (now <= numbers[END] && !(found == NEGATIVE && done == 1)) found = CONVERGED;
numbers[RR] = now;
status.data[world] = found;
iterations.data[world] = done;
};
if (shares_rows)
    for (int world = 0; world < worlds; ++world) solve_world(world);
else
    share_work(team, per_team, [&](int part) {
        for (long long world = part; world < worlds; world += per_team) solve_world(world);
    });
