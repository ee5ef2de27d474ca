// Prints what every keyframe of a running semidense knows: how many points, how far, how sure; and the size of the map.
//
//     c++ -std=c++17 keyframes.cpp -o keyframes $(pkg-config --cflags --libs semidense)
//     ./keyframes [INSTANCE [NUMBER_OF_KEYFRAMES]]
#include <algorithm>
#include <cmath>
#include <cstdlib>
#include <iostream>
#include <string>
#include <vector>

#include <semidense.hpp>

static const char USAGE[] = "usage: keyframes [INSTANCE [NUMBER_OF_KEYFRAMES]]\n"
                            "Prints what every keyframe knows; waits for the instance (default: semidense).\n";

static void print(const semidense::keyframe &keyframe) {
    std::vector<float> depths, deviations;
    for (const semidense_depth_point &point : keyframe.depth()) {
        // An inverse depth of 0 is infinitely far.
        if (point.inverse_depth > 0.0F) {
            depths.push_back(1.0F / point.inverse_depth);
            deviations.push_back(std::sqrt(point.variance) / point.inverse_depth);
        }
    }
    const auto median = [](std::vector<float> &values) {
        if (values.empty()) {
            return std::nanf("");
        }
        const auto middle = values.begin() + static_cast<std::ptrdiff_t>(values.size() / 2);
        std::nth_element(values.begin(), middle, values.end());
        return *middle;
    };
    unsigned long sum = 0;
    for (const std::uint8_t pixel : keyframe.pixels()) {
        sum += pixel;
    }
    std::cout << "keyframe " << keyframe.keyframe_id << " revision " << keyframe.revision << ": "
              << keyframe.num_points << " points, median depth " << median(depths) << " +- "
              << 100.0F * median(deviations) << " %, mean grey " << sum / std::max<std::size_t>(1, keyframe.pixels().size())
              << std::endl;
}

int main(int argc, char **argv) {
    const std::vector<std::string> arguments(argv + 1, argv + argc);
    if (arguments.size() == 1 && (arguments[0] == "--help" || arguments[0] == "-h")) {
        std::cout << USAGE;
        return 0;
    }
    char *end = nullptr;
    long left = arguments.size() > 1 ? std::strtol(argv[2], &end, 10) : -1;
    const bool is_number = arguments.size() < 2 || (end != argv[2] && *end == '\0' && left >= 0);
    if (arguments.size() > 2 || !is_number || (!arguments.empty() && arguments[0].rfind('-', 0) == 0)) {
        std::cerr << USAGE;
        return 2;
    }
    try {
        semidense::options where;
        if (!arguments.empty()) {
            where.instance = argv[1];
        }
        semidense::reader reader(SEMIDENSE_WANT_KEYFRAMES | SEMIDENSE_WANT_GRAPH | SEMIDENSE_WANT_FRAMES, where);
        while (left != 0 && reader.wait()) {
            if (const auto graph = reader.newest_graph()) {
                std::cout << "map revision " << graph->map_revision << ": " << graph->num_keyframes << " keyframes"
                          << std::endl;
            }
            if (const auto frame = reader.newest_frame(); frame && frame->image().empty()) {
                std::cerr << "a frame without pixels" << std::endl;
            }
            if (const auto keyframe = reader.newest_keyframe()) {
                print(*keyframe);
                left -= left > 0;
            }
        }
    } catch (const semidense::error &error) {
        std::cerr << semidense_status_name(error.status()) << ": " << error.what() << std::endl;
        return 1;
    }
    return 0;
}
