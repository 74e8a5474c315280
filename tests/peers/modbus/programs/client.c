/* A Modbus TCP client of libmodbus, told by lines what to ask. Numbers are registers.
 *
 *     client ADDRESS PORT
 *
 *     read ADDRESS COUNT                                function 3     ok VALUE...
 *     input ADDRESS COUNT                               function 4     ok VALUE...
 *     one ADDRESS VALUE                                 function 6     ok
 *     write ADDRESS VALUE...                            function 16    ok COUNT
 *     both READ-ADDRESS COUNT WRITE-ADDRESS VALUE...    function 23    ok VALUE...
 *     twice ADDRESS COUNT                               function 3 twice at once, as 7 and 8: ok ID, and again
 *     unit ID                                           for what follows: ok
 *
 * What is refused: "exception CODE"; what libmodbus does not understand: "error WHY".
 *
 * libmodbus is a program of its own here: it is under the LGPL. */
#include <errno.h>
#include <modbus/modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>

static modbus_t *modbus;

static void tell(int result, const uint16_t *values, int count) {
    int code = errno - MODBUS_ENOBASE;
    if (result >= 0) {
        printf("ok");
        for (int at = 0; at < count; at++) printf(" %u", values[at]);
        printf("\n");
    } else if (code > 0 && code < MODBUS_EXCEPTION_MAX) {
        printf("exception %d\n", code);
    } else {
        printf("error %s\n", modbus_strerror(errno));
    }
}

static void twice(uint16_t address, uint16_t count) {
    uint8_t requests[24], response[MODBUS_TCP_MAX_ADU_LENGTH];
    for (int at = 0; at < 2; at++) {
        uint8_t request[] = {0, (uint8_t)(7 + at), 0, 0, 0, 6, 0xFF, 3, address >> 8, address & 0xFF, count >> 8, count & 0xFF};
        memcpy(requests + sizeof request * at, request, sizeof request);
    }
    if (send(modbus_get_socket(modbus), requests, sizeof requests, 0) != sizeof requests) {
        printf("error send\n");
        return;
    }
    printf("ok");
    while (modbus_receive_confirmation(modbus, response) > 0) printf(" %u", response[0] << 8 | response[1]);
    printf("\n");
}

int main(int count, char **words) {
    if (count != 3) return 2;
    setvbuf(stdout, NULL, _IOLBF, 0);
    modbus = modbus_new_tcp(words[1], atoi(words[2]));
    if (!modbus || modbus_connect(modbus) < 0) {
        fprintf(stderr, "connect: %s\n", modbus_strerror(errno));
        return 1;
    }
    modbus_set_response_timeout(modbus, 2, 0);
    printf("ready\n");
    char line[4096];
    while (fgets(line, sizeof line, stdin)) {
        char *command = strtok(line, " \n"), *word;
        uint16_t numbers[256] = {0}, values[MODBUS_MAX_READ_REGISTERS] = {0};
        int said = 0;
        if (!command) continue;
        while (said < 256 && (word = strtok(NULL, " \n"))) numbers[said++] = (uint16_t)strtol(word, NULL, 0);
        if (!strcmp(command, "read")) {
            tell(modbus_read_registers(modbus, numbers[0], numbers[1], values), values, numbers[1]);
        } else if (!strcmp(command, "input")) {
            tell(modbus_read_input_registers(modbus, numbers[0], numbers[1], values), values, numbers[1]);
        } else if (!strcmp(command, "one")) {
            tell(modbus_write_register(modbus, numbers[0], numbers[1]), NULL, 0);
        } else if (!strcmp(command, "write")) {
            int written = modbus_write_registers(modbus, numbers[0], said - 1, numbers + 1);
            values[0] = (uint16_t)written;
            tell(written, values, 1);
        } else if (!strcmp(command, "both")) {
            tell(modbus_write_and_read_registers(modbus, numbers[2], said - 3, numbers + 3, numbers[0], numbers[1], values),
                 values, numbers[1]);
        } else if (!strcmp(command, "twice")) {
            twice(numbers[0], numbers[1]);
        } else if (!strcmp(command, "unit")) {
            tell(modbus_set_slave(modbus, numbers[0]), NULL, 0);
        }
    }
    return 0;
}
