/* A wall clock that a test sets: shifts CLOCK_REALTIME and related clocks by the seconds in a mapped file.
 *
 * For LD_PRELOAD; CLOCK_OFFSET_FILE is the path of the file, which contains two native doubles: by how much the clock
 * was set, and how long the machine has slept. The second also shifts CLOCK_BOOTTIME, as sleep does. Absolute deadlines,
 * as in Python's multiprocessing, are shifted back, because the kernel's clock is unchanged. CLOCK_MONOTONIC, which does
 * not run while a machine sleeps, and other clocks are not shifted.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <math.h>
#include <semaphore.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static const volatile double *offset; /* {set, slept}, s */
static int (*real_gettime)(clockid_t, struct timespec *);
static int (*real_timedwait)(sem_t *, const struct timespec *);

__attribute__((constructor)) static void start(void) {
    const char *path = getenv("CLOCK_OFFSET_FILE");
    int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
    if (file >= 0) {
        void *page = mmap(NULL, 2 * sizeof(double), PROT_READ, MAP_SHARED, file, 0);
        if (page != MAP_FAILED) offset = page;
        close(file);
    }
}

static struct timespec shifted(struct timespec at, double seconds) {
    double whole = floor(seconds);
    at.tv_sec += (time_t)whole;
    at.tv_nsec += (long)((seconds - whole) * 1e9);
    if (at.tv_nsec >= 1000000000L) {
        at.tv_nsec -= 1000000000L;
        at.tv_sec += 1;
    }
    return at;
}

int clock_gettime(clockid_t clock, struct timespec *at) {
    if (!real_gettime) real_gettime = dlsym(RTLD_NEXT, "clock_gettime");
    int failed = real_gettime(clock, at);
    if (failed || !offset) return failed;
    if (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE) *at = shifted(*at, offset[0] + offset[1]);
    if (clock == CLOCK_BOOTTIME) *at = shifted(*at, offset[1]);
    return 0;
}

int gettimeofday(struct timeval *restrict at, void *restrict zone) {
    (void)zone;
    struct timespec now;
    if (clock_gettime(CLOCK_REALTIME, &now)) return -1;
    at->tv_sec = now.tv_sec;
    at->tv_usec = now.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *at) {
    struct timespec now;
    if (clock_gettime(CLOCK_REALTIME, &now)) return -1;
    if (at) *at = now.tv_sec;
    return now.tv_sec;
}

int sem_timedwait(sem_t *restrict sem, const struct timespec *restrict deadline) {
    if (!real_timedwait) real_timedwait = dlsym(RTLD_NEXT, "sem_timedwait");
    if (!offset) return real_timedwait(sem, deadline);
    struct timespec end = shifted(*deadline, -(offset[0] + offset[1]));
    return real_timedwait(sem, &end);
}
