/* Prints the pose of every frame of a running semidense, waiting with poll as a program with other descriptors would.
 *
 *     cc -std=c11 poses.c -o poses $(pkg-config --cflags --libs semidense)
 *     ./poses [INSTANCE [NUMBER_OF_POSES]]
 */
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <semidense.h>

static const char USAGE[] = "usage: poses [INSTANCE [NUMBER_OF_POSES]]\n"
                            "Prints the pose of every frame; waits for the instance (default: semidense).\n";

static const char *const STATES[] = {"initializing", "tracking", "degraded", "lost"};

static int failed(const char *what) {
    fprintf(stderr, "%s: %s\n", what, semidense_last_error());
    return EXIT_FAILURE;
}

static void print(const semidense_pose *pose) {
    const double *t = pose->world_from_camera.translation;
    const double *q = pose->world_from_camera.quaternion;
    printf("%llu %s %.6f %.6f %.6f %.6f %.6f %.6f %.6f variance %.2g\n", (unsigned long long)pose->sequence,
           STATES[pose->state], t[0], t[1], t[2], q[0], q[1], q[2], q[3], pose->map_covariance[0]);
}

int main(int argc, char **argv) {
    if (argc == 2 && (strcmp(argv[1], "--help") == 0 || strcmp(argv[1], "-h") == 0)) {
        fputs(USAGE, stdout);
        return EXIT_SUCCESS;
    }
    const char *instance = argc > 1 ? argv[1] : NULL;
    char *end = NULL;
    long left = argc > 2 ? strtol(argv[2], &end, 10) : -1;
    int is_number = argc < 3 || (end != argv[2] && *end == '\0' && left >= 0);
    if (argc > 3 || !is_number || (argc > 1 && argv[1][0] == '-')) {
        fputs(USAGE, stderr);
        return 2;
    }
    semidense_reader *reader = NULL;
    if (semidense_open(instance, NULL, SEMIDENSE_WANT_POSES, -1, &reader) != SEMIDENSE_STATUS_OK) {
        return failed("open");
    }
    struct pollfd waited = {.fd = semidense_descriptor(reader), .events = POLLIN, .revents = 0};
    semidense_status status = SEMIDENSE_STATUS_OK;
    while (left != 0 && status >= 0 && status != SEMIDENSE_STATUS_ENDED) {
        /* Any of its own descriptors would stand beside this one. */
        if (poll(&waited, 1, -1) < 0) {
            break;
        }
        status = semidense_wait(reader, 0);
        semidense_pose pose;
        while (left != 0 && status >= 0 && semidense_next_pose(reader, &pose) == SEMIDENSE_STATUS_OK) {
            print(&pose);
            left -= left > 0;
        }
        fflush(stdout);
    }
    if (status < 0) {
        return failed("wait");
    }
    semidense_close(reader);
    return EXIT_SUCCESS;
}
