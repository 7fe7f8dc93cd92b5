// A clock on the wall that jumps, for a process that is begun with it in LD_PRELOAD.
//
// Every twentieth of a second of the steady clock it may show another time, which follows from
// CLOCK_SEED; the steady clock is as it was.

#define _GNU_SOURCE
#include <stdlib.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

#define SECOND 1000000000ULL
#define DAY 86400

static const long long JUMPS[] = {0, 0, 1, -1, 3600, -3600, DAY, -DAY, 9000 * DAY, -9000 * DAY};
#define KINDS (sizeof JUMPS / sizeof *JUMPS)

static void told(clockid_t id, struct timespec *at)
{
    syscall(SYS_clock_gettime, id, at);
}

static long long jump(void)
{
    const char *seed = getenv("CLOCK_SEED");
    struct timespec steady;
    told(CLOCK_MONOTONIC, &steady);
    unsigned long long part = steady.tv_sec * 20ULL + steady.tv_nsec / (SECOND / 20);
    part = (part + (seed ? strtoull(seed, NULL, 10) : 0)) * 0x9e3779b97f4a7c15ULL;
    return JUMPS[(part >> 40) % KINDS];
}

int clock_gettime(clockid_t id, struct timespec *at)
{
    int done = syscall(SYS_clock_gettime, id, at);
    if (!done && (id == CLOCK_REALTIME || id == CLOCK_REALTIME_COARSE))
        at->tv_sec += jump();
    return done;
}

int gettimeofday(struct timeval *restrict at, void *restrict zone)
{
    struct timespec now;
    (void)zone;
    clock_gettime(CLOCK_REALTIME, &now);
    at->tv_sec = now.tv_sec;
    at->tv_usec = now.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *at)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (at)
        *at = now.tv_sec;
    return now.tv_sec;
}
