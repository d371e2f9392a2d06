// As frames.h, where all frames are the axes of rest space.
const auto out_of_frame = [](const lanes8* s, lanes8* to) { for (int i = 0; i < 6; ++i) to[i] = s[i]; };
const auto into_frame = out_of_frame;
const auto to_frame = [](const triple& a) { return a; };
