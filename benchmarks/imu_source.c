/* A virtual LPMS-IG1 at rest: the frame sets of vehicles/monocab/vehicle.toml, at an exact rate.  imu_source IFACE RATE
 *
 * CANopen ids 18Ah, 28Ah, 38Ah; two 32-bit floats per frame: acceleration xyz in g, angular rate xyz in deg/s. The last
 * bits are noise, because a reading that never changes is detected as a stuck sensor. */
#define _GNU_SOURCE
#include <linux/can.h>
#include <linux/can/raw.h>
#include <net/if.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

static float noise(float size) { return size * (2.0f * rand() / RAND_MAX - 1.0f); }

int main(int argc, char **argv)
{
    if (argc != 3)
        return 2;
    int bus = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    struct sockaddr_can address = {.can_family = AF_CAN, .can_ifindex = if_nametoindex(argv[1])};
    setsockopt(bus, SOL_CAN_RAW, CAN_RAW_FILTER, NULL, 0); /* it only sends */
    if (bind(bus, (struct sockaddr *)&address, sizeof address)) {
        perror(argv[1]);
        return 1;
    }
    const long period = 1000000000L / atol(argv[2]);
    struct timespec next;
    clock_gettime(CLOCK_MONOTONIC, &next);
    for (;;) {
        if ((next.tv_nsec += period) >= 1000000000L) {
            next.tv_nsec -= 1000000000L;
            next.tv_sec++;
        }
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &next, NULL);
        const float slots[6] = {noise(1e-3f), noise(1e-3f), 1.0f + noise(1e-3f), noise(0.05f), noise(0.05f), noise(0.05f)};
        for (int place = 0; place < 3; place++) {
            struct can_frame frame = {.can_id = 0x18A + 0x100 * place, .can_dlc = 8};
            memcpy(frame.data, slots + 2 * place, 8);
            if (write(bus, &frame, sizeof frame) != sizeof frame)
                perror("write");
        }
    }
}
