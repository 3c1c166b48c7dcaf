// The two ends of TCPROS connections, fast enough not to distort a measurement.
//
//   wire source                                    serves topics; prints the port
//   wire sink HOST PORT CONNECTIONS WARM SECONDS   takes /stream; prints bytes of each connection
//   wire ping HOST PORT CONNECTIONS SECONDS SIZE   /echo there and back, one connection after the
//                                                  other; prints nanoseconds of each
//   wire hold HOST PORT CONNECTIONS TOPIC          connects, and does not read
//
// The sink lets the kernel throw the bytes away (MSG_TRUNC): a reader that copies would be the
// slower end of a direct connection. The sink prints `connected`, waits for a line on standard
// input, and prints `begin` and `end`. `wire hold` ends with its standard input.
#include <arpa/inet.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <unistd.h>

#include <cerrno>
#include <chrono>
#include <csignal>
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <iostream>
#include <string>
#include <thread>
#include <vector>

using Clock = std::chrono::steady_clock;
using Strings = std::vector<std::string>;

static const size_t kRead = 1 << 20, kTurn = 1 << 18;

[[noreturn]] static void fail(const std::string& what) {
  std::cerr << "wire: " << what << ": " << std::strerror(errno) << std::endl;
  std::exit(1);
}

static void say(const std::string& line) { std::cout << line << std::endl; }

static std::string field(const std::string& text) {
  uint32_t size = text.size();
  return std::string(reinterpret_cast<char*>(&size), 4) + text;
}

static std::string header(const Strings& fields) {
  std::string all;
  for (const auto& one : fields) all += field(one);
  return field(all);
}

static bool writeAll(int fd, const char* data, size_t size) {
  while (size > 0) {
    ssize_t done = send(fd, data, size, MSG_NOSIGNAL);
    if (done <= 0) return false;
    data += done;
    size -= done;
  }
  return true;
}

static bool readAll(int fd, char* data, size_t size) {
  while (size > 0) {
    ssize_t done = recv(fd, data, size, 0);
    if (done <= 0) return false;
    data += done;
    size -= done;
  }
  return true;
}

// The body of a connection header; empty if there is none.
static std::string readHeader(int fd) {
  uint32_t size = 0;
  if (!readAll(fd, reinterpret_cast<char*>(&size), 4) || size > 65536) return "";
  std::string body(size, '\0');
  return readAll(fd, body.data(), size) ? body : "";
}

static void noDelay(int fd) {
  int on = 1;
  setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
}

static void echo(int fd) {
  std::vector<char> buffer(65536);
  ssize_t size;
  while ((size = recv(fd, buffer.data(), buffer.size(), 0)) > 0)
    if (!writeAll(fd, buffer.data(), size)) return;
}

// A single thread for all, with a bounded write for each connection in turn: a fair source, so that
// the shares show the fairness of the relay.
static void stream(int poll) {
  static const std::vector<char> data(kTurn, 'x');
  std::vector<epoll_event> events(1024);
  while (true) {
    int ready = epoll_wait(poll, events.data(), events.size(), -1);
    for (int i = 0; i < ready; i++) {
      int fd = events[i].data.fd;
      ssize_t size = send(fd, data.data(), data.size(), MSG_NOSIGNAL | MSG_DONTWAIT);
      if (size < 0 && errno != EAGAIN) close(fd);
    }
  }
}

static void serve(int fd, int streams) {
  noDelay(fd);
  bool echoes = readHeader(fd).find("topic=/echo") != std::string::npos;
  std::string reply = header({"callerid=/bench_inside", "type=std_msgs/String", "latching=0",
                              "md5sum=992ce8a1687cec8c8bd883ec73ca41d1",
                              "message_definition=string data\n"});
  if (!writeAll(fd, reply.data(), reply.size()) || echoes) {
    echo(fd);
    close(fd);
    return;
  }
  epoll_event event{EPOLLOUT, {}};
  event.data.fd = fd;
  epoll_ctl(streams, EPOLL_CTL_ADD, fd, &event);
}

static int source() {
  int server = socket(AF_INET, SOCK_STREAM, 0);
  sockaddr_in address{};
  socklen_t size = sizeof address;
  address.sin_family = AF_INET;
  if (bind(server, reinterpret_cast<sockaddr*>(&address), size) || listen(server, 4096)) fail("bind");
  getsockname(server, reinterpret_cast<sockaddr*>(&address), &size);
  say(std::to_string(ntohs(address.sin_port)));
  int streams = epoll_create1(0);
  std::thread(stream, streams).detach();
  while (true) {
    int fd = accept(server, nullptr, nullptr);
    if (fd >= 0) std::thread(serve, fd, streams).detach();
  }
}

static int connected(const Strings& to, const std::string& topic) {
  int fd = socket(AF_INET, SOCK_STREAM, 0);
  timeval patience{20, 0};
  setsockopt(fd, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
  noDelay(fd);
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_port = htons(std::stoi(to[1]));
  inet_pton(AF_INET, to[0].c_str(), &address.sin_addr);
  if (connect(fd, reinterpret_cast<sockaddr*>(&address), sizeof address)) fail("connect");
  std::string hello = header({"callerid=/bench_outside", "topic=" + topic, "type=std_msgs/String",
                              "md5sum=992ce8a1687cec8c8bd883ec73ca41d1", "tcp_nodelay=1"});
  if (!writeAll(fd, hello.data(), hello.size()) || readHeader(fd).empty()) fail("no header");
  return fd;
}

static std::vector<int> connectedMany(const Strings& arguments, const std::string& topic) {
  std::vector<int> sockets(std::stoi(arguments[2]));
  for (auto& fd : sockets) fd = connected(arguments, topic);
  return sockets;
}

// Reads and counts, with a single read of a connection at a time.
class Sink {
 public:
  explicit Sink(const std::vector<int>& sockets) : sockets_(sockets), counts_(sockets.size()) {
    poll_ = epoll_create1(0);
    for (uint32_t i = 0; i < sockets.size(); i++) {
      epoll_event event{EPOLLIN, {}};
      event.data.u32 = i;
      epoll_ctl(poll_, EPOLL_CTL_ADD, sockets[i], &event);
    }
  }

  // The elapsed seconds.
  double take(double seconds) {
    auto begin = Clock::now();
    std::fill(counts_.begin(), counts_.end(), 0);
    double took = 0;
    while (took < seconds) {
      turn();
      took = std::chrono::duration<double>(Clock::now() - begin).count();
    }
    return took;
  }

  const std::vector<uint64_t>& counts() const { return counts_; }

 private:
  void turn() {
    static std::vector<epoll_event> events(1024);
    static std::vector<char> buffer(kRead);
    int ready = epoll_wait(poll_, events.data(), events.size(), 20);
    for (int i = 0; i < ready; i++) {
      uint32_t which = events[i].data.u32;
      ssize_t size = recv(sockets_[which], buffer.data(), kRead, MSG_TRUNC | MSG_DONTWAIT);
      if (size == 0 || (size < 0 && errno != EAGAIN)) fail("the stream ended");
      if (size > 0) counts_[which] += size;
    }
  }

  std::vector<int> sockets_;
  std::vector<uint64_t> counts_;
  int poll_;
};

static int sink(const Strings& arguments) {
  Sink sink(connectedMany(arguments, "/stream"));
  say("connected");
  std::string go;
  std::getline(std::cin, go);
  sink.take(std::stod(arguments[3]));
  say("begin");
  double took = sink.take(std::stod(arguments[4]));
  say("end");
  say(std::to_string(took));
  for (auto count : sink.counts()) std::cout << count << ' ';
  say("");
  return 0;
}

static uint64_t bounce(int fd, std::vector<char>& message) {
  auto begin = Clock::now();
  if (!writeAll(fd, message.data(), message.size())) fail("send");
  if (!readAll(fd, message.data(), message.size())) fail("nothing came back");
  return std::chrono::duration_cast<std::chrono::nanoseconds>(Clock::now() - begin).count();
}

static int ping(const Strings& arguments) {
  auto sockets = connectedMany(arguments, "/echo");
  std::vector<char> message(std::stoi(arguments[4]), 'x');
  // A warm-up that does not count: once around, and a hundred times at least.
  for (size_t i = 0; i < std::max<size_t>(100, sockets.size()); i++)
    bounce(sockets[i % sockets.size()], message);
  std::vector<uint64_t> times;
  auto end = Clock::now() + std::chrono::duration<double>(std::stod(arguments[3]));
  for (size_t i = 0; Clock::now() < end; i++)
    times.push_back(bounce(sockets[i % sockets.size()], message));
  for (auto time : times) std::cout << time << ' ';
  say("");
  return 0;
}

static int hold(const Strings& arguments) {
  auto sockets = connectedMany(arguments, arguments[3]);
  std::vector<char> message(1024, 'x');
  if (arguments[3] == "/echo")
    for (int fd : sockets) bounce(fd, message);
  say("connected");
  std::string line;
  while (std::getline(std::cin, line)) {
  }
  return 0;
}

int main(int argc, char** argv) {
  signal(SIGPIPE, SIG_IGN);
  Strings arguments(argv + std::min(argc, 2), argv + argc);
  std::string role = argc > 1 ? argv[1] : "";
  if (role == "source") return source();
  if (role == "sink" && arguments.size() == 5) return sink(arguments);
  if (role == "ping" && arguments.size() == 5) return ping(arguments);
  if (role == "hold" && arguments.size() == 4) return hold(arguments);
  std::cerr << "wire: see the top of wire.cpp" << std::endl;
  return 2;
}
