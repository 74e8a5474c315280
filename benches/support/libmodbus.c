/*
 * A blocking client over libmodbus, paced on a grid: one request with function 23 a period.
 *
 *   libmodbus HOST PORT UNIT WRITE READ COUNT STATUS PRIORITY CORE
 *
 * Brings the drive into operation, says "ready", and takes one line with the first instant of the grid (ns of CLOCK_MONOTONIC), the
 * period (ns) and the number of slots. Then it prints how many slots it executed and how many it passed over, and each round trip,
 * ns. CORE -1 is any, PRIORITY 0 an ordinary process.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <inttypes.h>
#include <modbus/modbus.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>

/* What is written: control word and speed reference, 32 bits each, the high word first. */
enum { WRITTEN = 4, CONTROL = 1, READ_MAX = 125 };
enum { IDLE = 0x0180, FORWARD = 0x0183, ACTIVE = 1 << 1 };

static modbus_t *drive;
static int write_at, read_at, count, status;
static uint16_t written[WRITTEN], values[READ_MAX];

static int64_t now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
}

static void sleep_until(int64_t at)
{
    struct timespec t = {.tv_sec = at / 1000000000, .tv_nsec = at % 1000000000};
    while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL) == EINTR) {
    }
}

static void give_up(const char *what)
{
    fprintf(stderr, "%s: %s\n", what, modbus_strerror(errno));
    exit(1);
}

static void exchange(void)
{
    if (modbus_write_and_read_registers(drive, write_at, WRITTEN, written, read_at, count, values) != count)
        give_up("exchange");
}

/* As the loop's thread: nobody has to grant it. */
static void become_real_time(int priority, int core)
{
    cpu_set_t set;
    CPU_ZERO(&set);
    CPU_SET(core < 0 ? 0 : core, &set);
    if (core >= 0)
        sched_setaffinity(0, sizeof set, &set);
    struct sched_param parameters = {.sched_priority = priority};
    if (priority > 0)
        sched_setscheduler(0, SCHED_FIFO, &parameters);
    mlockall(MCL_CURRENT | MCL_FUTURE);
}

int main(int argc, char **argv)
{
    if (argc != 10)
        return 2;
    write_at = atoi(argv[4]);
    read_at = atoi(argv[5]);
    count = atoi(argv[6]);
    status = atoi(argv[7]);
    if (count < 1 || count > READ_MAX || status < 0 || status >= count)
        return 2;
    drive = modbus_new_tcp(argv[1], atoi(argv[2]));
    if (!drive || modbus_set_slave(drive, atoi(argv[3])) || modbus_connect(drive))
        give_up("connect");

    written[CONTROL] = IDLE;
    for (int n = 0; n < 20; n++) {
        exchange();
        sleep_until(now() + 1000000);
    }
    written[CONTROL] = FORWARD;
    for (int n = 0; !(values[status] & ACTIVE); n++) {
        if (n == 2000) {
            fprintf(stderr, "the drive does not come into operation\n");
            return 1;
        }
        exchange();
        sleep_until(now() + 1000000);
    }
    printf("ready\n");
    fflush(stdout);

    int64_t grid, period;
    long slots;
    if (scanf("%" SCNd64 " %" SCNd64 " %ld", &grid, &period, &slots) != 3 || period < 1 || slots < 1)
        return 2;
    int64_t *round_trips = calloc(slots, sizeof *round_trips);
    if (!round_trips)
        return 1;
    become_real_time(atoi(argv[8]), atoi(argv[9]));
    long executed = 0, skipped = 0;
    for (long slot = 0; slot < slots; slot++, grid += period) {
        if (now() > grid + period / 2) {
            skipped++;
            continue;
        }
        sleep_until(grid);
        int64_t sent = now();
        exchange();
        round_trips[executed++] = now() - sent;
    }
    printf("%ld %ld\n", executed, skipped);
    for (long n = 0; n < executed; n++)
        printf("%" PRId64 "\n", round_trips[n]);
    modbus_close(drive);
    modbus_free(drive);
    return 0;
}
