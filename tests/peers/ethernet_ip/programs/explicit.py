"""Explicit messages of pycomm3 or cpppo, one for each argument.

    explicit.py pycomm3|pycomm3-connected|cpppo ADDRESS MESSAGE...

A message is SERVICE/CLASS/INSTANCE/ATTRIBUTE/DATA, all of it hexadecimal, without attribute or data where there is
none. For each of them a line: the data of the reply, or "failed". The first line is what ListIdentity found.
"""

import sys

library, address, *messages = sys.argv[1:]


def numbers(message):
    service, of_class, instance, attribute, data = message.split("/")
    attribute = int(attribute, 16) if attribute else None
    return int(service, 16), int(of_class, 16), int(instance, 16), attribute, bytes.fromhex(data)


def with_pycomm3():
    from pycomm3 import CIPDriver

    found = CIPDriver.list_identity(address)
    print(found["vendor"], found["product_name"], found["state"], found["ip_address"])
    with CIPDriver(address) as driver:
        for message in messages:
            service, of_class, instance, attribute, data = numbers(message)
            reply = driver.generic_message(
                service=bytes([service]),
                class_code=of_class,
                instance=instance,
                attribute=b"" if attribute is None else attribute,
                request_data=data,
                connected=library == "pycomm3-connected",
                unconnected_send=False,
                route_path=None,
            )
            print("failed" if reply.error else reply.value.hex())


def with_cpppo():
    from cpppo.server.enip import client

    with client.connector(host=address, timeout=10) as connection:
        connection.list_identity(timeout=10)
        reply, _ = client.await_response(connection, timeout=10)
        found = reply.enip.CIP.list_identity.CPF.item[0].identity_object
        # It numbers vendors, and knows no names.
        print(found.vendor_id, found.product_name, found.state, found.sin_addr)
        for message in messages:
            service, of_class, instance, attribute, data = numbers(message)
            path = [{"class": of_class}, {"instance": instance}]
            path += [] if attribute is None else [{"attribute": attribute}]
            connection.service_code(
                code=service, path=path, data=list(data), route_path=[], send_path="", timeout=10
            )
            reply, _ = client.await_response(connection, timeout=10)
            reply = reply.enip.CIP.send_data.CPF.item[1].unconnected_send.request
            # The replies of services that it knows have names.
            known = {0x0E: "get_attribute_single", 0x01: "get_attributes_all"}.get(service, "service_code")
            print("failed" if reply.status else bytes(reply[known].data).hex())


with_cpppo() if library == "cpppo" else with_pycomm3()
