/* The minimal responder to an IMU frame set: waits for its last frame, sends a setpoint.  echo IFACE TRIGGER REPLY */
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <unistd.h>

int main(int argc, char **argv)
{
    if (argc != 4)
        return 2;
    int bus = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    struct can_filter trigger = {strtoul(argv[2], NULL, 16), CAN_SFF_MASK | CAN_EFF_FLAG | CAN_RTR_FLAG};
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = if_nametoindex(argv[1])};
    setsockopt(bus, SOL_CAN_RAW, CAN_RAW_FILTER, &trigger, sizeof trigger);
    if (bind(bus, (struct sockaddr *)&address, sizeof address)) {
        perror(argv[1]);
        return 1;
    }
    struct can_frame frame, setpoint = {.can_id = strtoul(argv[3], NULL, 16), .can_dlc = 6};
    while (read(bus, &frame, sizeof frame) == sizeof frame)
        if (write(bus, &setpoint, sizeof setpoint) != sizeof setpoint)
            perror("write");
    return 1;
}
