/* The least that a relay does: takes datagrams from one UDP port and sends them to another, many at once.
   Run: relay LISTEN_PORT TARGET_PORT; ends by a signal. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>

enum { MOST = 64, BYTES = 65536 };

static struct sockaddr_in loopback(const char *port) {
    struct sockaddr_in at = {.sin_family = AF_INET, .sin_port = htons((unsigned short)atoi(port))};
    at.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    return at;
}

int main(int argc, char **argv) {
    static unsigned char data[MOST][BYTES];
    static struct iovec parts[MOST];
    static struct mmsghdr messages[MOST];
    int size = 8 << 20, in = socket(AF_INET, SOCK_DGRAM, 0), out = socket(AF_INET, SOCK_DGRAM, 0);
    if (argc != 3 || in < 0 || out < 0) return 2;
    struct sockaddr_in from = loopback(argv[1]), to = loopback(argv[2]);
    setsockopt(in, SOL_SOCKET, SO_RCVBUF, &size, sizeof size);
    if (bind(in, (struct sockaddr *)&from, sizeof from) || connect(out, (struct sockaddr *)&to, sizeof to)) return 1;
    for (int i = 0; i < MOST; i++) messages[i].msg_hdr = (struct msghdr){.msg_iov = &parts[i], .msg_iovlen = 1};
    puts("ready");
    fflush(stdout);
    for (;;) {
        for (int i = 0; i < MOST; i++) parts[i] = (struct iovec){data[i], BYTES};
        int count = recvmmsg(in, messages, MOST, MSG_WAITFORONE, NULL);
        for (int i = 0; i < count; i++) parts[i].iov_len = messages[i].msg_len;
        if (count > 0) sendmmsg(out, messages, (unsigned)count, 0);
    }
}
