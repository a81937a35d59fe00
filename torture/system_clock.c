/* A system clock that can be set for some processes alone: LD_PRELOAD this, built by
   torture/clocks.py. CLOCK_OFFSET names a file of 8 bytes: nanoseconds on top of the real clock,
   which may change at any time. Steady clocks stay as they are, as when the real one is set. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static volatile const long long *offset_ns;

__attribute__((constructor)) static void begin(void)
{
    const char *path = getenv("CLOCK_OFFSET");
    int file = path ? open(path, O_RDONLY | O_CLOEXEC) : -1;
    void *place = file < 0 ? MAP_FAILED : mmap(NULL, 8, PROT_READ, MAP_SHARED, file, 0);
    if (place != MAP_FAILED)
        offset_ns = place;
}

int clock_gettime(clockid_t id, struct timespec *now)
{
    int result = syscall(SYS_clock_gettime, id, now);
    if (result == 0 && offset_ns && id == CLOCK_REALTIME) {
        long long ns = now->tv_sec * 1000000000LL + now->tv_nsec + *offset_ns;
        now->tv_sec = ns / 1000000000LL;
        now->tv_nsec = ns % 1000000000LL;
    }
    return result;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone)
{
    struct timespec precise;
    clock_gettime(CLOCK_REALTIME, &precise);
    now->tv_sec = precise.tv_sec;
    now->tv_usec = precise.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *now)
{
    struct timespec precise;
    clock_gettime(CLOCK_REALTIME, &precise);
    if (now)
        *now = precise.tv_sec;
    return precise.tv_sec;
}

/* A wait until a time of the system clock ends when that clock says so, as the kernel's does: early
   if it is set forth, late if it is set back. So each is cut in slices of a millisecond of the
   steady clock; returns 0 if the time is over. */
static int next_slice(const struct timespec *end, struct timespec *slice)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    long long left_ns = (end->tv_sec - now.tv_sec) * 1000000000LL + end->tv_nsec - now.tv_nsec;
    if (left_ns <= 0)
        return 0;
    clock_gettime(CLOCK_MONOTONIC, slice);
    long long until_ns = slice->tv_nsec + (left_ns < 1000000 ? left_ns : 1000000);
    slice->tv_sec += until_ns / 1000000000LL;
    slice->tv_nsec = until_ns % 1000000000LL;
    return 1;
}

/* Who has asked for the steady clock (Python does) is told by its small numbers. */
static int is_steady(const struct timespec *end)
{
    return end->tv_sec < 1000000000;
}

/* How often each condition was signalled, by its address: a signal between two slices finds nobody
   who waits. That two share a count makes a wait end for nothing, which any wait may. */
#define COUNTS 4096
static volatile unsigned signalled[COUNTS];

static volatile unsigned *count_of(const pthread_cond_t *condition)
{
    return &signalled[(uintptr_t)condition / 16 % COUNTS];
}

static int signal_with(const char *name, pthread_cond_t *condition)
{
    __atomic_add_fetch(count_of(condition), 1, __ATOMIC_SEQ_CST);
    return ((int (*)(pthread_cond_t *))dlsym(RTLD_NEXT, name))(condition);
}

int pthread_cond_signal(pthread_cond_t *condition)
{
    return signal_with("pthread_cond_signal", condition);
}

int pthread_cond_broadcast(pthread_cond_t *condition)
{
    return signal_with("pthread_cond_broadcast", condition);
}

int pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *mutex,
                           const struct timespec *end)
{
    if (is_steady(end))
        return pthread_cond_clockwait(condition, mutex, CLOCK_MONOTONIC, end);
    unsigned before = *count_of(condition);
    struct timespec slice;
    while (next_slice(end, &slice)) {
        int result = pthread_cond_clockwait(condition, mutex, CLOCK_MONOTONIC, &slice);
        if (result != ETIMEDOUT || *count_of(condition) != before)
            return result == ETIMEDOUT ? 0 : result;
    }
    return ETIMEDOUT;
}

/* Fast DDS waits with these for its ports and locks in shared memory. */
int sem_timedwait(sem_t *semaphore, const struct timespec *end)
{
    struct timespec slice;
    while (next_slice(end, &slice)) {
        int result = sem_clockwait(semaphore, CLOCK_MONOTONIC, &slice);
        if (result == 0 || errno != ETIMEDOUT)
            return result;
    }
    errno = ETIMEDOUT;
    return -1;
}

int pthread_mutex_timedlock(pthread_mutex_t *restrict mutex, const struct timespec *restrict end)
{
    struct timespec slice;
    int result = pthread_mutex_trylock(mutex);
    while (result == EBUSY && next_slice(end, &slice))
        if ((result = pthread_mutex_clocklock(mutex, CLOCK_MONOTONIC, &slice)) == ETIMEDOUT)
            result = EBUSY;
    return result == EBUSY ? ETIMEDOUT : result;
}
