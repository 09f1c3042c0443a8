/* A V4L2 device behind a socket, for LD_PRELOAD.
 *
 * A device node is a Unix socket (SOCK_SEQPACKET) on which v4l2_device.py listens. To open it connects; the device
 * greets with two descriptors: the memory of its buffers, and a socket that carries ioctls. The connection itself is
 * the descriptor that the caller gets: one byte arrives on it for each buffer that is filled, so that poll and select
 * need no help, and it hangs up when the device is pulled.
 *
 * Everything else goes straight to the kernel.
 */
#define _GNU_SOURCE
#include <errno.h>
#include <fcntl.h>
#include <linux/videodev2.h>
#include <pthread.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <sys/un.h>
#include <unistd.h>

#define MOST_DEVICES 8
#define MOST_BYTES 1024

struct device {
    int node; /* 0 where the place is free */
    int memory;
    int control;
    pthread_mutex_t speaking;
};

struct request {
    uint32_t code;
    uint8_t argument[MOST_BYTES];
};

struct answer {
    int32_t error;
    uint8_t argument[MOST_BYTES];
};

static struct device devices[MOST_DEVICES];
static pthread_mutex_t opening = PTHREAD_MUTEX_INITIALIZER;

static struct device *device_of(int fd)
{
    for (int i = 0; fd > 0 && i < MOST_DEVICES; i++)
        if (devices[i].node == fd)
            return &devices[i];
    return NULL;
}

static int take_greeting(int node, int *memory, int *control)
{
    char byte;
    union {
        struct cmsghdr head;
        char bytes[CMSG_SPACE(2 * sizeof(int))];
    } room;
    struct iovec data = {&byte, 1};
    struct msghdr message = {.msg_iov = &data, .msg_iovlen = 1, .msg_control = &room, .msg_controllen = sizeof room};
    int fds[2];

    if (recvmsg(node, &message, MSG_CMSG_CLOEXEC) != 1)
        return -1;
    struct cmsghdr *head = CMSG_FIRSTHDR(&message);
    if (head == NULL || head->cmsg_type != SCM_RIGHTS || head->cmsg_len != CMSG_LEN(sizeof fds))
        return -1;
    memcpy(fds, CMSG_DATA(head), sizeof fds);
    *memory = fds[0];
    *control = fds[1];
    return 0;
}

static int plug_in(const char *path)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    int memory, control, node;

    if (strlen(path) >= sizeof address.sun_path) {
        errno = ENAMETOOLONG;
        return -1;
    }
    strcpy(address.sun_path, path);
    node = socket(AF_UNIX, SOCK_SEQPACKET | SOCK_CLOEXEC, 0);
    if (node < 0)
        return -1;
    if (connect(node, (struct sockaddr *)&address, sizeof address) != 0 || take_greeting(node, &memory, &control) != 0) {
        syscall(SYS_close, node);
        errno = ENODEV;
        return -1;
    }
    pthread_mutex_lock(&opening);
    for (int i = 0; i < MOST_DEVICES; i++) {
        if (devices[i].node == 0) {
            devices[i] = (struct device){node, memory, control, PTHREAD_MUTEX_INITIALIZER};
            pthread_mutex_unlock(&opening);
            return node;
        }
    }
    pthread_mutex_unlock(&opening);
    syscall(SYS_close, memory);
    syscall(SYS_close, control);
    syscall(SYS_close, node);
    errno = EMFILE;
    return -1;
}

int open(const char *path, int flags, ...)
{
    va_list rest;
    va_start(rest, flags);
    mode_t mode = flags & O_CREAT ? va_arg(rest, mode_t) : 0;
    va_end(rest);
    int fd = syscall(SYS_openat, AT_FDCWD, path, flags, mode);
    /* A socket cannot be opened. */
    return fd < 0 && errno == ENXIO ? plug_in(path) : fd;
}

int open64(const char *path, int flags, ...)
{
    va_list rest;
    va_start(rest, flags);
    mode_t mode = flags & O_CREAT ? va_arg(rest, mode_t) : 0;
    va_end(rest);
    return open(path, flags, mode);
}

int close(int fd)
{
    struct device *device = device_of(fd);
    if (device != NULL) {
        device->node = 0;
        syscall(SYS_close, device->memory);
        syscall(SYS_close, device->control);
    }
    return syscall(SYS_close, fd);
}

static void forget_filled(const struct device *device, int all)
{
    char byte;
    while (recv(device->node, &byte, 1, MSG_DONTWAIT) == 1 && all)
        ;
}

static int ask(struct device *device, unsigned long code, void *argument)
{
    struct request request = {.code = (uint32_t)code};
    struct answer answer;
    size_t size = _IOC_SIZE(code);
    ssize_t got = -1;

    memcpy(request.argument, argument, size);
    pthread_mutex_lock(&device->speaking);
    if (send(device->control, &request, offsetof(struct request, argument) + size, MSG_NOSIGNAL) > 0)
        got = recv(device->control, &answer, sizeof answer, 0);
    pthread_mutex_unlock(&device->speaking);
    if (got != (ssize_t)(offsetof(struct answer, argument) + size)) {
        errno = ENODEV;
        return -1;
    }
    memcpy(argument, answer.argument, size);
    if (answer.error != 0) {
        errno = answer.error;
        return -1;
    }
    if (code == VIDIOC_DQBUF || code == VIDIOC_STREAMOFF)
        forget_filled(device, code == VIDIOC_STREAMOFF);
    return 0;
}

int ioctl(int fd, unsigned long code, ...)
{
    va_list rest;
    va_start(rest, code);
    void *argument = va_arg(rest, void *);
    va_end(rest);
    struct device *device = device_of(fd);
    return device != NULL ? ask(device, code, argument) : syscall(SYS_ioctl, fd, code, argument);
}

void *mmap(void *address, size_t length, int protection, int flags, int fd, off_t offset)
{
    struct device *device = device_of(fd);
    return (void *)syscall(SYS_mmap, address, length, protection, flags, device != NULL ? device->memory : fd, offset);
}

void *mmap64(void *address, size_t length, int protection, int flags, int fd, off_t offset)
{
    return mmap(address, length, protection, flags, fd, offset);
}
