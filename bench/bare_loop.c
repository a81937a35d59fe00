/* A loop that only sleeps until its next period: bare_loop SECONDS RATE_HZ PRIORITY.

   Prints how many periods it slept through: what this machine itself loses, without Python,
   ROS or DDS. PRIORITY of SCHED_FIFO, if that is permitted. */
#define _GNU_SOURCE
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>

#define SECOND_NS 1000000000LL

static long long now_ns(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * SECOND_NS + now.tv_nsec;
}

int main(int count, char **arguments)
{
    if (count != 4)
        return 2;
    long long period_ns = (long long)(SECOND_NS / atof(arguments[2])), lost = 0;
    struct sched_param priority = {.sched_priority = atoi(arguments[3])};
    sched_setscheduler(0, SCHED_FIFO, &priority);
    mlockall(MCL_CURRENT | MCL_FUTURE);
    long long next_ns = now_ns(), end_ns = next_ns + (long long)(SECOND_NS * atof(arguments[1]));
    while (next_ns < end_ns) {
        next_ns += period_ns;
        struct timespec until = {next_ns / SECOND_NS, next_ns % SECOND_NS};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, NULL);
        long long slept_through = (now_ns() - next_ns) / period_ns;
        lost += slept_through;
        next_ns += slept_through * period_ns;
    }
    printf("%lld\n", lost);
    return 0;
}
