/* Times an exported model: `timing mean|std|state|state_std|nothing CALLS QUERIES TIMES ANSWERS`.
 *
 * QUERIES: float64 q, dq, ddq of each, a motion of 1 kHz; TIMES: ns of each call (int64), all queries in turn; ANSWERS:
 * float64 tau and tau_std of each query. `state` includes the update. `nothing` measures the clock itself. */
#define _POSIX_C_SOURCE 200112L
#include "lipserve_model.h"

#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

enum { N = LIPSERVE_JOINTS };

static int64_t now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)1000000000 * t.tv_sec + t.tv_nsec;
}

int main(int count, char **given)
{
    long calls, queries, k;
    double(*x)[3][N], (*answers)[2][N];
    int64_t *times;
    lipserve_state state;
    FILE *file;
    if (count != 6 || (file = fopen(given[3], "rb")) == 0 || lipserve_selftest() != 0)
        return 1;
    calls = atol(given[2]);
    fseek(file, 0, SEEK_END);
    queries = ftell(file) / (long)sizeof *x;
    rewind(file);
    x = malloc((size_t)queries * sizeof *x);
    answers = calloc((size_t)queries, sizeof *answers);
    times = malloc((size_t)calls * sizeof *times);
    if (!x || !answers || !times || fread(x, sizeof *x, (size_t)queries, file) != (size_t)queries)
        return 1;
    fclose(file);
    lipserve_start(&state);
    for (k = 0; k < calls; k++) {
        const double(*q)[N] = (const double(*)[N])x[k % queries];
        double *tau = answers[k % queries][0], *tau_std = answers[k % queries][1];
        const int64_t began = now();
        if (!strcmp(given[1], "std"))
            lipserve_torque_std(q[0], q[1], q[2], tau, tau_std);
        else if (!strcmp(given[1], "mean"))
            lipserve_torque(q[0], q[1], q[2], tau);
        else if (!strncmp(given[1], "state", 5)) {
            lipserve_update(&state, q[0], q[1], 1e-3);
            lipserve_torque_state(q[0], q[1], q[2], NULL, &state, tau, given[1][5] ? tau_std : NULL);
        }
        times[k] = now() - began;
    }
    file = fopen(given[4], "wb");
    if (!file || fwrite(times, sizeof *times, (size_t)calls, file) != (size_t)calls || fclose(file))
        return 1;
    file = fopen(given[5], "wb");
    return !file || fwrite(answers, sizeof *answers, (size_t)queries, file) != (size_t)queries || fclose(file);
}
