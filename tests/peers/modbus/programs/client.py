"""A Modbus TCP client of pymodbus, told by lines what to ask. Numbers are registers.

    client.py ADDRESS PORT

    read ADDRESS COUNT                                function 3     ok VALUE...
    input ADDRESS COUNT                               function 4     ok VALUE...
    one ADDRESS VALUE                                 function 6     ok
    write ADDRESS VALUE...                            function 16    ok COUNT
    both READ-ADDRESS COUNT WRITE-ADDRESS VALUE...    function 23    ok VALUE...
    twice ADDRESS COUNT                               function 3 twice at once, as 7 and 8: ok ID, and again
    unit ID                                           for what follows: ok

What is refused: "exception CODE"; what pymodbus does not understand: "error WHY".
"""

import sys

from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.framer import FramerSocket
from pymodbus.pdu import DecodePDU
from pymodbus.pdu.register_message import ReadHoldingRegistersRequest

client = ModbusTcpClient(sys.argv[1], port=int(sys.argv[2]), timeout=2, retries=0)
unit = 255


def twice(address, count):
    framer = FramerSocket(DecodePDU(False))
    requests = [
        ReadHoldingRegistersRequest(address=address, count=count, dev_id=255, transaction_id=id) for id in (7, 8)
    ]
    client.socket.sendall(b"".join(map(framer.buildFrame, requests)))
    ids, rest = [], b""
    client.socket.settimeout(2)
    try:
        while more := client.socket.recv(1024):
            rest += more
            while rest:
                used, pdu = framer.handleFrame(rest, 255, 0)
                rest = rest[used:]
                if pdu is None:
                    break
                ids.append(pdu.transaction_id)
    except TimeoutError:
        pass
    return ids


def ask(command, numbers):
    global unit
    match command:
        case "read":
            return client.read_holding_registers(numbers[0], count=numbers[1], device_id=unit)
        case "input":
            return client.read_input_registers(numbers[0], count=numbers[1], device_id=unit)
        case "one":
            return client.write_register(numbers[0], numbers[1], device_id=unit)
        case "write":
            return client.write_registers(numbers[0], numbers[1:], device_id=unit)
        case "both":
            return client.readwrite_registers(
                read_address=numbers[0],
                read_count=numbers[1],
                write_address=numbers[2],
                values=numbers[3:],
                device_id=unit,
            )
        case "twice":
            return twice(*numbers)
        case "unit":
            unit = numbers[0]
            return []


def told(command, answer):
    if isinstance(answer, list):
        return ["ok", *answer]
    if answer.isError():
        return ["exception", answer.exception_code]
    if command == "write":
        return ["ok", answer.count]
    return ["ok"] if command == "one" else ["ok", *answer.registers]


if not client.connect():
    sys.exit("no connection")
print("ready", flush=True)
for line in sys.stdin:
    command, *words = line.split()
    try:
        print(*told(command, ask(command, [int(word, 0) for word in words])), flush=True)
    except ModbusException as error:
        print("error", error, flush=True)
