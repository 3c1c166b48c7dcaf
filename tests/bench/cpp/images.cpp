// A roscpp node that publishes or receives images, by commands on standard input.
//
//   go TOPIC BYTES RATE SECONDS WINDOW SOCKET   -> "= sent COUNT"
//   on TOPIC SOCKET                             -> "= on"
//   count                                       -> "= count COUNT"
//   off                                         -> "= got COUNT SECONDS MICROSECONDS..."
//
// With RATE 0 the node sends whenever at most WINDOW messages are on the way. The receiver reports
// arrivals by datagrams to SOCKET, past the network. images.py takes the same commands.
#include <ros/ros.h>
#include <sensor_msgs/Image.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include <iostream>
#include <mutex>
#include <sstream>
#include <thread>
#include <vector>

static const double kPatience = 10;

static sockaddr_un at(const std::string& path) {
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  path.copy(address.sun_path, sizeof address.sun_path - 1);
  return address;
}

// The number of messages that may still be sent.
class Window {
 public:
  Window(const std::string& path, int size) : path_(path), left_(size) {
    fd_ = socket(AF_UNIX, SOCK_DGRAM, 0);
    auto address = at(path);
    unlink(path.c_str());
    if (bind(fd_, reinterpret_cast<sockaddr*>(&address), sizeof address)) throw std::runtime_error(path);
    timeval patience{1, 0};
    setsockopt(fd_, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
  }
  ~Window() {
    close(fd_);
    unlink(path_.c_str());
  }
  // A lost message frees its place after a second.
  void take() {
    char byte;
    while (recv(fd_, &byte, 1, left_ > 0 ? MSG_DONTWAIT : 0) == 1) left_++;
    if (left_ == 0) left_++;
    left_--;
  }

 private:
  std::string path_;
  int left_;
  int fd_;
};

static bool waitForSubscriber(const ros::Publisher& publisher) {
  for (double waited = 0; waited < kPatience; waited += 0.01) {
    if (publisher.getNumSubscribers() > 0) return true;
    ros::WallDuration(0.01).sleep();
  }
  return false;
}

static std::string go(ros::NodeHandle& node, ros::Publisher& publisher, std::istream& words) {
  std::string topic, path;
  double bytes, rate, seconds;
  int window;
  words >> topic >> bytes >> rate >> seconds >> window >> path;
  publisher = node.advertise<sensor_msgs::Image>(topic, 1000);
  if (!waitForSubscriber(publisher)) return "failed: no subscriber";
  ros::WallDuration(0.1).sleep();
  sensor_msgs::Image image;
  image.data.resize(bytes);
  Window left(path, window);
  auto begin = ros::WallTime::now(), end = begin + ros::WallDuration(seconds);
  int count = 0;
  for (; ros::WallTime::now() < end; count++) {
    if (rate > 0)
      ros::WallTime::sleepUntil(begin + ros::WallDuration(count / rate));
    else
      left.take();
    image.header.stamp = ros::Time::now();
    publisher.publish(image);
  }
  return "sent " + std::to_string(count);
}

class Receiver {
 public:
  void on(ros::NodeHandle& node, std::istream& words) {
    std::string topic, path;
    words >> topic >> path;
    publisher_ = at(path);
    times_.clear();
    subscriber_ = node.subscribe(topic, 1000, &Receiver::take, this,
                                 ros::TransportHints().tcpNoDelay());
  }

  std::string count() {
    std::lock_guard<std::mutex> guard(mutex_);
    return "count " + std::to_string(times_.size());
  }

  std::string off() {
    subscriber_.shutdown();
    std::lock_guard<std::mutex> guard(mutex_);
    std::ostringstream line;
    double took = times_.empty() ? 0 : (last_ - first_).toSec();
    line << "got " << times_.size() << ' ' << took;
    for (double time : times_) line << ' ' << static_cast<long>(time * 1e6);
    return line.str();
  }

 private:
  void take(const sensor_msgs::Image::ConstPtr& image) {
    auto now = ros::Time::now();
    sendto(fd_, "x", 1, MSG_DONTWAIT, reinterpret_cast<sockaddr*>(&publisher_), sizeof publisher_);
    std::lock_guard<std::mutex> guard(mutex_);
    if (times_.empty()) first_ = now;
    last_ = now;
    times_.push_back((now - image->header.stamp).toSec());
  }

  int fd_ = socket(AF_UNIX, SOCK_DGRAM, 0);
  sockaddr_un publisher_{};
  ros::Subscriber subscriber_;
  ros::Time first_, last_;
  std::vector<double> times_;
  std::mutex mutex_;
};

int main(int argc, char** argv) {
  ros::init(argc, argv, "images", ros::init_options::NoRosout);
  ros::NodeHandle node;
  ros::Publisher publisher;
  Receiver receiver;
  ros::AsyncSpinner spinner(1);
  spinner.start();
  std::cout << "= ready" << std::endl;
  for (std::string line; std::getline(std::cin, line);) {
    std::istringstream words(line);
    std::string command, reply = "on";
    words >> command;
    if (command == "go") reply = go(node, publisher, words);
    if (command == "on") receiver.on(node, words);
    if (command == "count") reply = receiver.count();
    if (command == "off") reply = receiver.off();
    std::cout << "= " << reply << std::endl;
  }
  return 0;
}
