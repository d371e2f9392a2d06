// ln(1 + j) of positive 1 + j: twice the artanh of j / (2 + j), of what powers of two leave within sqrt(2).
const auto log_of = [&](const lanes8& j) {
    const lanes8 whole = 1.0f + j;
    const masks8 bits = reinterpret_cast<const masks8&>(whole);
    const masks8 power = (bits - 0x3f3504f3) >> 23;
    const masks8 reduced = bits - (power << 23);
    const lanes8 rest = power == 0 ? j : reinterpret_cast<const lanes8&>(reduced) - 1.0f;
    const lanes8 z = rest / (2.0f + rest), zz = z * z;
    const lanes8 series = 1.0f + zz * (1.0f / 3 + zz * (0.2f + zz * (1.0f / 7 + zz * (1.0f / 9))));
    return 0.6931472f * __builtin_convertvector(power, lanes8) + 2.0f * z * series;
};
