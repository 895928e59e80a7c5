/* Sends the frames of a capture round and round at a rate, past the queueing disciplines, in bursts of 0.1 ms or more.
   Run: frames INTERFACE CAPTURE RATE SECONDS (pcap of microseconds in the machine's byte order, at most 16,384
   frames); prints what was sent and how long that took. A burst that was due long ago is not made up for. */
#define _GNU_SOURCE
#include <linux/if_packet.h>
#include <net/ethernet.h>
#include <net/if.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>

enum { MOST = 16384, BURST = 64, PCAP_HEAD = 24, RECORD_HEAD = 16, MOST_LATE = 4096 };

static struct iovec parts[MOST];
static struct mmsghdr messages[MOST];

static double now(void) {
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return at.tv_sec + at.tv_nsec / 1e9;
}

static long load(const char *path) {
    FILE *file = fopen(path, "rb");
    uint32_t head[4];
    long count = 0;
    if (!file || fseek(file, PCAP_HEAD, SEEK_SET)) return 0;
    for (; count < MOST && fread(head, RECORD_HEAD, 1, file) == 1; count++) {
        parts[count] = (struct iovec){malloc(head[2]), head[2]};
        if (fread(parts[count].iov_base, 1, head[2], file) != head[2]) break;
        messages[count].msg_hdr = (struct msghdr){.msg_iov = &parts[count], .msg_iovlen = 1};
    }
    fclose(file);
    return count;
}

int main(int argc, char **argv) {
    if (argc != 5) return 2;
    long frames = load(argv[2]), rate = atol(argv[3]), sent = 0, missed = 0;
    double seconds = atof(argv[4]);
    int out = socket(AF_PACKET, SOCK_RAW, 0), yes = 1;
    struct sockaddr_ll to = {.sll_family = AF_PACKET, .sll_ifindex = (int)if_nametoindex(argv[1])};
    setsockopt(out, SOL_PACKET, PACKET_QDISC_BYPASS, &yes, sizeof yes);
    if (!frames || bind(out, (struct sockaddr *)&to, sizeof to)) return 1;
    double began = now(), passed;
    while ((passed = now() - began) < seconds) {
        long due = (long)(passed * (double)rate) - missed - sent;
        if (due > MOST_LATE) missed += due - MOST_LATE, due = MOST_LATE;
        if (due <= 0) {
            nanosleep(&(struct timespec){.tv_nsec = 100000}, NULL);
            continue;
        }
        long first = sent % frames, many = due < BURST ? due : BURST;
        if (many > frames - first) many = frames - first;
        int done = sendmmsg(out, messages + first, (unsigned)many, 0);
        if (done < 0) return 1;
        sent += done;
    }
    printf("{\"sent\": %ld, \"seconds\": %.4f}\n", sent, now() - began);
}
