// Adds one term to 2 G' at eigenvalues e of Green's strain; see ogden.py. In: e; M, REST, POWER, LOW, HIGH; ``log_of``;
// ``power_excess``. In and out: slope.
const lanes8 inside = e < LOW ? spread(LOW) : e > HIGH ? spread(HIGH) : e;
const lanes8 inverse = 1.0f / (1.0f + 2.0f * inside);
const lanes8 of_power = power_excess(POWER * log_of(2.0f * inside)), of_inverse = -2.0f * inside * inverse;
const lanes8 curvature = (M * POWER * (1.0f + of_power) + REST * inverse) * inverse;
slope += M * of_power - REST * of_inverse + 2.0f * curvature * (e - inside);
