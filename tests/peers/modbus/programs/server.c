/* A Modbus TCP server of libmodbus with one register for each address, told by lines what they hold.
 *
 *     server ADDRESS PORT [no-read-write | ignores-read-write | closes-on-read-write]
 *
 *     set ADDRESS VALUE...    ok
 *     get ADDRESS COUNT       ok VALUE...
 *     counts                  ok TOTAL FC3 FC6 FC16 FC23
 *
 * libmodbus is a program of its own here: it is under the LGPL. */
#include <errno.h>
#include <modbus/modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <unistd.h>

#define READ_WRITE 23
#define REGISTERS 0x7000
#define CONNECTIONS 8

static modbus_t *modbus;
static modbus_mapping_t *registers;
static long counts[256], total;

static void fail(const char *what) {
    fprintf(stderr, "%s: %s\n", what, modbus_strerror(errno));
    exit(1);
}

/* One line of standard input; false at its end. */
static int told(void) {
    char line[4096];
    if (!fgets(line, sizeof line, stdin)) return 0;
    char *command = strtok(line, " \n"), *word;
    long numbers[256];
    int count = 0;
    while (count < 256 && (word = strtok(NULL, " \n"))) numbers[count++] = strtol(word, NULL, 0);
    printf("ok");
    if (command && !strcmp(command, "counts")) {
        printf(" %ld %ld %ld %ld %ld", total, counts[3], counts[6], counts[16], counts[READ_WRITE]);
    } else if (command && !strcmp(command, "get")) {
        for (long at = 0; at < numbers[1]; at++) printf(" %u", registers->tab_registers[numbers[0] + at]);
    } else {
        for (int at = 1; at < count; at++) registers->tab_registers[numbers[0] + at - 1] = (uint16_t)numbers[at];
    }
    printf("\n");
    return 1;
}

/* What it does with function 23. */
enum read_write { SERVED, REFUSED, IGNORED, CLOSES };

/* One request on a connection; false if that has ended. */
static int asked(int connection, enum read_write read_write) {
    uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
    modbus_set_socket(modbus, connection);
    int length = modbus_receive(modbus, request);
    if (length <= 0) return length == 0;
    int function = request[modbus_get_header_length(modbus)];
    total++;
    counts[function]++;
    if (function == READ_WRITE && read_write >= IGNORED) return read_write == IGNORED;
    if (function == READ_WRITE && read_write == REFUSED) {
        modbus_reply_exception(modbus, request, MODBUS_EXCEPTION_ILLEGAL_FUNCTION);
    } else {
        modbus_reply(modbus, request, length, registers);
    }
    return 1;
}

int main(int count, char **words) {
    if (count < 3) return 2;
    const char *option = count < 4 ? "" : words[3];
    enum read_write read_write = !strcmp(option, "ignores-read-write")     ? IGNORED
                                 : !strcmp(option, "closes-on-read-write") ? CLOSES
                                 : *option                                 ? REFUSED
                                                                           : SERVED;
    setvbuf(stdout, NULL, _IOLBF, 0);
    /* What select tells is told of lines as they come, not of a buffer of theirs. */
    setvbuf(stdin, NULL, _IONBF, 0);
    modbus = modbus_new_tcp(words[1], atoi(words[2]));
    registers = modbus_mapping_new(0, 0, REGISTERS, 0);
    if (!modbus || !registers) fail("modbus");
    int listener = modbus_tcp_listen(modbus, CONNECTIONS);
    if (listener < 0) fail("listen");
    printf("ready\n");
    fd_set all, ready;
    FD_ZERO(&all);
    FD_SET(STDIN_FILENO, &all);
    FD_SET(listener, &all);
    int most = listener;
    for (;;) {
        ready = all;
        if (select(most + 1, &ready, NULL, NULL, NULL) < 0) fail("select");
        if (FD_ISSET(STDIN_FILENO, &ready) && !told()) return 0;
        if (FD_ISSET(listener, &ready)) {
            int connection = modbus_tcp_accept(modbus, &listener);
            if (connection < 0) fail("accept");
            FD_SET(connection, &all);
            if (connection > most) most = connection;
        }
        for (int at = listener + 1; at <= most; at++) {
            if (FD_ISSET(at, &ready) && !asked(at, read_write)) {
                close(at);
                FD_CLR(at, &all);
            }
        }
    }
}
