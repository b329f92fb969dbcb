/* Assesses and watches rows of a binary file; writes what they say and the time of each call. */
#define _POSIX_C_SOURCE 199309L
#include "gamma.h"

#include <stdio.h>
#include <time.h>

static double now_us(void) {
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return 1e6 * (double)t.tv_sec + 1e-3 * (double)t.tv_nsec;
}

int main(int argc, char **argv) {
    static gamma_inputs inputs;
    static gamma_assessment said;
    static gamma_monitor monitor;
    FILE *in = argc == 3 ? fopen(argv[1], "rb") : NULL, *out = argc == 3 ? fopen(argv[2], "wb") : NULL;
    if (in == NULL || out == NULL) return 1;
    while (fread(&inputs, sizeof inputs, 1, in) == 1) {
        double row[7], begin = now_us(), middle;
        gamma_assess(&inputs, 0.0, &said);
        middle = now_us();
        gamma_watch(&inputs, &monitor);
        row[6] = now_us() - middle;
        row[5] = middle - begin;
        row[4] = monitor.alarm;
        row[3] = said.safety_probability;
        for (int i = 0; i < 3; ++i) row[i] = said.belief[i];
        fwrite(row, sizeof row, 1, out);
    }
    fclose(in);
    return fclose(out);
}
