"""A master made of SOEM, by its Python wrapper pysoem: soem.py INTERFACE turn|hold|hold-unwatched.

It brings every slave of the segment to OP. Then `turn` turns the first drive, sets and resets the outputs of the
terminals, and goes back to INIT; `hold` keeps the first drive turning until this process is killed, and so does
`hold-unwatched`, with the watchdogs of all outputs switched off. A line on standard output says what it saw, beginning
with a word for what it is about. The end with another exit code than 0 is an exception of Python.
"""

import itertools
import os
import sys
import time

import pysoem

PERIOD_NS = 4_000_000
KOLLMORGEN = 0x6A
# Two analogue inputs, with a mailbox.
EL3102 = 0x0C1E3052
# Counts of the velocity setpoint.
VELOCITY = 5_000
# Whoever runs this may have a busy computer.
LONG_S = 40
WATCHDOG_MS = 1_000
ERROR = 0x10
DELAY, FEATURES = 0x0928, 0x0008


def say(*words):
    print(*words, flush=True)


def number(data):
    return int.from_bytes(data, "little", signed=False)


class Segment:
    """All slaves of an interface, in a cycle that follows the clock of the first one that has a clock."""

    def __init__(self, interface):
        self.master = pysoem.Master()
        self.master.sdo_read_timeout = self.master.sdo_write_timeout = 10_000_000
        self.master.open(interface)
        say("slaves", self.master.config_init())
        self.slaves = self.master.slaves
        self.next = time.monotonic_ns()
        self.counter = 0

    def drives(self):
        return [slave for slave in self.slaves if slave.man == KOLLMORGEN]

    @staticmethod
    def clock(slave):
        """0: none, 32 or 64 bits."""
        return (0, 32, 0, 64)[number(slave._fprd(FEATURES, 2)) >> 2 & 3]

    def describe(self):
        for place, slave in enumerate(self.slaves):
            say("identity", place, hex(slave.man), hex(slave.id))
            words = [number(slave.eeprom_read(word)) for word in (0x08, 0x0A)]
            say("sii", place, *map(hex, words))
            self.describe_sii(place, slave)
            say("clock", place, self.clock(slave))
        for place, slave in enumerate(self.slaves):
            if slave.man == KOLLMORGEN or slave.id == EL3102:
                say("product", place, hex(number(slave.sdo_read(0x1018, 2))))
                self.describe_objects(place, slave)

    @staticmethod
    def describe_sii(place, slave):
        """Its categories but the general one, and the PDOs of slaves with a mailbox, which it describes itself."""
        at = 0x40
        while True:
            header = slave.eeprom_read(at)
            kind, words = number(header[:2]), number(header[2:])
            if kind == 0xFFFF:
                return
            content = b"".join(slave.eeprom_read(at + 2 + word) for word in range(0, words, 2))[: 2 * words]
            has_mailbox = number(slave.eeprom_read(0x18)) != 0
            if kind != 30 and not (kind in (50, 51) and has_mailbox):
                say("category", place, kind, content.hex())
            at += 2 + words

    def describe_objects(self, place, slave):
        lists = [(list_, 1 + n) for list_ in (0x1C12, 0x1C13) for n in range(slave.sdo_read(list_, 0)[0])]
        for list_, n in lists:
            pdo = number(slave.sdo_read(list_, n)[:2])
            count = slave.sdo_read(pdo, 0)[0]
            entries = (number(slave.sdo_read(pdo, 1 + entry)) for entry in range(count))
            say("mapped", place, hex(pdo), *map(hex, entries))
        try:
            say("read", number(slave.sdo_read(0x5FFF, 1)))
        except pysoem.SdoError as error:
            say("abort", place, hex(error.abort_code))

    def set_up(self):
        for slave in self.drives():
            slave.sdo_write(0x60C2, 1, bytes([PERIOD_NS // 1_000_000]))
            slave.sdo_write(0x60C2, 2, (-3).to_bytes(1, "little", signed=True))
        say("image", self.master.config_map())
        self.set_clocks()
        for slave in self.drives():
            slave.dc_sync(True, PERIOD_NS, PERIOD_NS // 2)

    def set_clocks(self):
        """A receive time whose frame is late on a busy computer counts as 0 in the delays: they are taken again."""
        clocks = {place: slave for place, slave in enumerate(self.slaves) if self.clock(slave)}
        for _ in range(20):
            self.master.config_dc()
            delays = {place: number(slave._fprd(DELAY, 4)) for place, slave in clocks.items()}
            if max(delays.values(), default=0) < PERIOD_NS:
                break
        for place, delay in delays.items():
            say("delay", place, delay)

    def cycle(self):
        """One exchange of process data, half a period before the next SYNC0 of the drives."""
        while time.monotonic_ns() < self.next:
            pass
        self.master.send_processdata()
        self.counter = self.master.receive_processdata(20_000)
        phase = (self.master.dc_time + PERIOD_NS // 2) % PERIOD_NS - PERIOD_NS // 2
        late = time.monotonic_ns() > self.next + PERIOD_NS
        self.next = (time.monotonic_ns() if late else self.next) + PERIOD_NS - phase // 16

    def until(self, what, done):
        end = time.monotonic() + LONG_S
        while not done():
            if time.monotonic() > end:
                self.master.read_state()
                states = [(hex(slave.state), hex(slave.al_status), slave.input) for slave in self.slaves]
                raise TimeoutError(f"not {what}: {states}, counter {self.counter}")
            self.cycle()

    def states(self):
        self.master.read_state()
        return {slave.state for slave in self.slaves}

    def to_op(self):
        """SAFEOP first; a drive that has lost the clock meanwhile is asked again."""
        self.until("SAFEOP", lambda: self.states() == {pysoem.SAFEOP_STATE})
        say("state SAFEOP")
        # The drives see regular cycles first.
        for _ in range(500):
            self.cycle()
        end = time.monotonic() + LONG_S
        while self.states() != {pysoem.OP_STATE}:
            if time.monotonic() > end:
                self.until("OP", lambda: False)
            for slave in self.slaves:
                if slave.state == pysoem.SAFEOP_STATE | ERROR:
                    slave.state = pysoem.SAFEOP_STATE | pysoem.STATE_ACK
                    slave.write_state()
                elif slave.state == pysoem.SAFEOP_STATE:
                    slave.state = pysoem.OP_STATE
                    slave.write_state()
            for _ in range(100):
                self.cycle()
        say("state OP")
        self.cycle()
        say("counter", self.counter, self.master.expected_wkc)

    def look_for_dictionary(self):
        """The last thing that is done by mailbox: the wrapper takes an error of this for that of the next SDO."""
        try:
            say("objects", len(self.drives()[-1].od))
        except pysoem.SdoInfoError as error:
            say("no-objects", error)

    def turn(self):
        drive, *others = self.drives()
        status = lambda: number(drive.input[6:8])
        position = lambda slave: int.from_bytes(slave.input[:4], "little", signed=True)

        def control(word, velocity=0):
            drive.output = velocity.to_bytes(4, "little", signed=True) + word.to_bytes(2, "little")

        for word, state in ((0x06, 0x21), (0x07, 0x23), (0x0F, 0x27)):
            control(word)
            self.until(hex(state), lambda: status() & 0x6F == state)
            say("status", hex(status()))
        begin, still = position(drive), [position(slave) for slave in others]
        control(0x0F, VELOCITY)
        for _ in range(100):
            self.cycle()
        say("moved", position(drive) - begin, *(position(slave) - old for slave, old in zip(others, still)))
        return lambda: control(0x06)

    def terminals(self):
        """Each output terminal shows two patterns; what all the others read then."""
        for place, slave in enumerate(self.slaves):
            if slave.man == KOLLMORGEN or not slave.output:
                continue
            for pattern in (0x55, 0xAA):
                slave.output = bytes([pattern]) * len(slave.output)
                for _ in range(20):
                    self.cycle()
                read = [other.input.hex() for other in self.slaves if other.man != KOLLMORGEN and other.input]
                say("wired", place, slave.output.hex(), *read)


def main():
    interface, what = sys.argv[1:]
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(60))
    segment = Segment(interface)
    segment.describe()
    segment.set_up()
    for slave in segment.slaves:
        slave.set_watchdog("processdata", 0 if what == "hold-unwatched" else WATCHDOG_MS)
    segment.to_op()
    stop = segment.turn()
    if what != "turn":
        say("holding")
        for _ in itertools.count():
            segment.cycle()
    segment.terminals()
    stop()
    for _ in range(20):
        segment.cycle()
    for state in (pysoem.SAFEOP_STATE, pysoem.PREOP_STATE, pysoem.INIT_STATE):
        if state == pysoem.INIT_STATE:
            segment.look_for_dictionary()
        segment.master.state = state
        segment.master.write_state()
        segment.until(hex(state), lambda: segment.states() == {state})
    say("state INIT")
    segment.master.close()


main()
