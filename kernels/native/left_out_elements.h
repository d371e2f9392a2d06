// Puts elements that are not ``sound`` on a list: how many, then which. In: sound. Out: missed.
if (any(~sound)) {
    for (int lane = 0; lane < end; ++lane) {
        if (!sound[lane]) missed.data[++missed.data[0]] = first_element + lane;
    }
}
