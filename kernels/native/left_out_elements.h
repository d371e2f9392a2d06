// Puts elements that are not ``sound`` on the list of those left out: how many, then which.
if (any(~sound)) {
    for (int lane = 0; lane < end; ++lane) {
        if (!sound[lane]) left_out.data[++left_out.data[0]] = first_element + lane;
    }
}
