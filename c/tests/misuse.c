/* Every function with null, closed, invented and foreign readers and misaligned structures: errors with words, never a crash. */
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <semidense.h>

static int failures = 0;

static void expect(int line, const char *call, semidense_status got, semidense_status wanted, const char *words) {
    const char *said = semidense_last_error();
    if (got != wanted || (words != NULL && strstr(said, words) == NULL)) {
        fprintf(stderr, "line %d: %s gave %s, not %s with '%s': %s\n", line, call, semidense_status_name(got),
                semidense_status_name(wanted), words ? words : "", said);
        failures += 1;
    }
}
#define EXPECT(call, status, words) expect(__LINE__, #call, (call), SEMIDENSE_STATUS_##status, words)

static void *elsewhere(void *reader) {
    semidense_pose pose;
    EXPECT(semidense_next_pose(reader, &pose), ERROR_HANDLE, "another thread");
    EXPECT(semidense_wait(reader, 0), ERROR_HANDLE, "another thread");
    EXPECT(semidense_close(reader), ERROR_HANDLE, "another thread");
    return NULL;
}

/* A reader that is never closed goes with its thread. */
static void *forgetful(void *unused) {
    semidense_reader *reader = NULL;
    EXPECT(semidense_open(NULL, NULL, SEMIDENSE_WANT_FRAMES, 120000, &reader), OK, NULL);
    return unused;
}

static void without_reader(semidense_reader *reader, const char *words) {
    semidense_pose pose;
    semidense_frame frame;
    semidense_keyframe keyframe;
    semidense_graph graph;
    EXPECT(semidense_wait(reader, 0), ERROR_HANDLE, words);
    EXPECT(semidense_next_pose(reader, &pose), ERROR_HANDLE, words);
    EXPECT(semidense_newest_frame(reader, &frame), ERROR_HANDLE, words);
    EXPECT(semidense_newest_keyframe(reader, &keyframe), ERROR_HANDLE, words);
    EXPECT(semidense_newest_graph(reader, &graph), ERROR_HANDLE, words);
    if (semidense_descriptor(reader) != -1 || semidense_refused(reader) != 0) {
        fprintf(stderr, "a descriptor or a count of no reader\n");
        failures += 1;
    }
}

int main(void) {
    semidense_reader *reader = NULL;
    const uint32_t poses = SEMIDENSE_WANT_POSES;
    EXPECT(semidense_open(NULL, NULL, poses, 0, NULL), ERROR_ARGUMENT, "reader is null");
    EXPECT(semidense_open("a/b", NULL, poses, 0, &reader), ERROR_ARGUMENT, "a/b");
    EXPECT(semidense_open("\xff\xfe", NULL, poses, 0, &reader), ERROR_ARGUMENT, "UTF-8");
    EXPECT(semidense_open(NULL, NULL, 0, 0, &reader), ERROR_ARGUMENT, "SEMIDENSE_WANT");
    EXPECT(semidense_open(NULL, NULL, 99, 0, &reader), ERROR_ARGUMENT, "SEMIDENSE_WANT");
    EXPECT(semidense_open("nobody", NULL, poses, 10, &reader), ERROR_NOT_RUNNING, "nobody");
    if (reader != NULL) {
        failures += 1;
    }
    without_reader(NULL, "null, closed");
    without_reader((semidense_reader *)(uintptr_t)12345, "closed");
    without_reader((semidense_reader *)&failures, "closed");
    EXPECT(semidense_close(NULL), OK, NULL);
    EXPECT(semidense_close((semidense_reader *)&failures), ERROR_HANDLE, "closed");

    EXPECT(semidense_open(NULL, NULL, poses, 120000, &reader), OK, NULL);
    semidense_frame frame;
    semidense_keyframe keyframe;
    semidense_graph graph;
    EXPECT(semidense_newest_frame(reader, &frame), ERROR_NOT_WANTED, "SEMIDENSE_WANT_FRAMES");
    EXPECT(semidense_newest_keyframe(reader, &keyframe), ERROR_NOT_WANTED, "SEMIDENSE_WANT_KEYFRAMES");
    EXPECT(semidense_newest_graph(reader, &graph), ERROR_NOT_WANTED, "SEMIDENSE_WANT_GRAPH");
    EXPECT(semidense_next_pose(reader, NULL), ERROR_ARGUMENT, "null");
    char *room = malloc(sizeof(semidense_pose) + 8);
    if (room != NULL) {
        EXPECT(semidense_next_pose(reader, (semidense_pose *)(void *)(room + 1)), ERROR_ARGUMENT, "aligned");
    }
    free(room);
    double matrix[16];
    EXPECT(semidense_matrix(NULL, matrix), ERROR_ARGUMENT, "transform is null");
    const semidense_transform transform = {{0, 0, 0, 1}, {1, 2, 3}, 2};
    EXPECT(semidense_matrix(&transform, NULL), ERROR_ARGUMENT, "matrix is null");
    EXPECT(semidense_matrix(&transform, matrix), OK, NULL);
    if (matrix[0] != 2 || matrix[7] != 2 || matrix[15] != 1) {
        failures += 1;
    }

    pthread_t thread;
    pthread_create(&thread, NULL, elsewhere, reader);
    pthread_join(thread, NULL);
    pthread_create(&thread, NULL, forgetful, NULL);
    pthread_join(thread, NULL);
    EXPECT(semidense_close(reader), OK, NULL);
    EXPECT(semidense_close(reader), ERROR_HANDLE, "closed");
    without_reader(reader, "closed");
    /* Opened again it is another one, and stays open to the end of the program. */
    semidense_reader *again = NULL;
    EXPECT(semidense_open(NULL, NULL, poses, 120000, &again), OK, NULL);
    if (again == reader || strcmp(semidense_status_name(77), "unknown status") != 0) {
        failures += 1;
    }
    printf("%s wire %u\n", semidense_version(), semidense_wire_version());
    return failures == 0 ? EXIT_SUCCESS : EXIT_FAILURE;
}
