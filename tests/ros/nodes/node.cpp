// Small roscpp nodes, one for each role. node.py takes the same arguments.
//
//     node ROLE [--option value]... [__name:=NAME]
//
// Each node prints plain lines for the tests.
#include <ros/ros.h>
#include <std_msgs/String.h>
#include <topic_tools/MuxSelect.h>

#include <boost/crc.hpp>
#include <fstream>
#include <functional>
#include <iomanip>
#include <sstream>

#include "node.hpp"

// `word number` filled up to `size` characters.
static std::string payload(const std::string& word, int number, size_t size) {
  std::string text = word + " " + std::to_string(number) + " ";
  size_t head = text.size();
  text.reserve(size);
  while (text.size() < size) text.push_back('a' + (text.size() - head) % 26);
  return text;
}

// The identity of a payload: the first two words, the size and the checksum.
static std::string describe(const std::string& text) {
  std::string word, number;
  std::istringstream(text.substr(0, 100)) >> word >> number;
  boost::crc_32_type crc;
  crc.process_bytes(text.data(), text.size());
  std::ostringstream line;
  line << word << " " << number << " size " << text.size() << " crc " << std::hex
       << std::setw(8) << std::setfill('0') << crc.checksum() << " at " << std::dec << std::fixed
       << std::setprecision(3) << ros::WallTime::now().toSec();
  return line.str();
}

// Publishes for ever, or `--count` messages; latched with `--latch 1`; `--queue 0`: no limit.
static void publish(const Options& options) {
  ros::NodeHandle node;
  bool latch = options.number("latch", 0) > 0;
  auto queue = static_cast<uint32_t>(options.number("queue", 10));
  auto publisher = node.advertise<std_msgs::String>(options.text("topic"), queue, latch);
  ros::WallRate rate(options.number("rate", 20));
  size_t size = static_cast<size_t>(options.number("size", 0));
  double count = options.number("count", 1e9);
  say("ready");
  for (int number = 0; number < count && ros::ok(); ++number) {
    std_msgs::String message;
    message.data = payload(options.text("word", "hello"), number, size);
    publisher.publish(message);
    say("sent " + describe(message.data));
    ros::spinOnce();
    rate.sleep();
  }
  ros::spin();
}

// Publishes; once the file `--when` exists, also to `--then`. `--last` ends the first topic then.
static void publishMore(const Options& options) {
  ros::NodeHandle node;
  auto first = node.advertise<std_msgs::String>(options.text("topic"), 10);
  ros::Publisher second;
  ros::WallRate rate(20);
  std_msgs::String message;
  message.data = payload("more", 0, 0);
  say("ready");
  while (ros::ok()) {
    if (!second && std::ifstream(options.text("when"))) {
      second = node.advertise<std_msgs::String>(options.text("then"), 10);
      if (options.number("last", 0) > 0) first.shutdown();
      say("more");
    }
    if (first) first.publish(message);
    if (second) second.publish(message);
    ros::spinOnce();
    rate.sleep();
  }
}

static void onMessage(const std_msgs::String::ConstPtr& message) {
  say("got " + describe(message->data));
}

// Prints every message; `--udp 1` asks for UDPROS alone; `--queue 0`: a queue without limit.
static void subscribe(const Options& options) {
  ros::NodeHandle node;
  ros::TransportHints hints;
  if (options.number("udp", 0) > 0) hints.unreliable();
  auto queue = static_cast<uint32_t>(options.number("queue", 100));
  auto subscriber = node.subscribe(options.text("topic"), queue, onMessage, hints);
  say("ready");
  ros::spin();
}

static bool answer(topic_tools::MuxSelect::Request& request,
                   topic_tools::MuxSelect::Response& response) {
  say("request " + describe(request.topic));
  response.prev_topic = "echo " + request.topic;
  return true;
}

// A service that answers `echo REQUEST`.
static void serve(const Options& options) {
  ros::NodeHandle node;
  auto server = node.advertiseService(options.text("service"), answer);
  say("ready");
  ros::spin();
}

// Calls, and repeats a failed call unless the connection is persistent. With a connection for each
// call, roscpp loses a reply in some 7,000 calls, also without anything between two roscpp nodes.
static bool callOnceOrTwice(ros::ServiceClient& client, topic_tools::MuxSelect& call) {
  return client.call(call) || (!client.isPersistent() && client.call(call));
}

// Waits for the service, then makes `--count` calls, and prints failed calls.
static void call(const Options& options) {
  ros::NodeHandle node;
  std::string service = options.text("service");
  bool persistent = options.number("persistent", 0) > 0;
  say("waiting");
  if (!ros::service::waitForService(service, ros::Duration(options.number("patience", 30)))) return;
  auto client = node.serviceClient<topic_tools::MuxSelect>(service, persistent);
  ros::WallRate rate(options.number("rate", 20));
  size_t size = static_cast<size_t>(options.number("size", 0));
  for (int number = 0; number < options.number("count", 1) && ros::ok(); ++number) {
    topic_tools::MuxSelect call;
    call.request.topic = payload("ask", number, size);
    if (callOnceOrTwice(client, call))
      say("reply " + describe(call.response.prev_topic.substr(5)));
    else
      say("failed " + std::to_string(number));
    rate.sleep();
  }
  say("done");
}

// Sets `--key` to a value of each type that roscpp can send.
static void setParameters(const Options& options) {
  ros::NodeHandle node;
  std::string key = options.text("key");
  XmlRpc::XmlRpcValue list, table;
  list[0] = 1;
  list[1] = std::string("two");
  list[2] = 3.5;
  table["flag"] = true;
  table["list"] = list;
  table["empty"] = std::string("");
  node.setParam(key + "/int", -42);
  node.setParam(key + "/double", 0.1);
  node.setParam(key + "/whole", 2.0);
  node.setParam(key + "/bool", true);
  node.setParam(key + "/string", std::string("  a <b> & \"c\"\n"));
  node.setParam(key + "/empty", std::string(""));
  node.setParam(key + "/list", list);
  node.setParam(key + "/table", table);
  char bytes[] = {0, 1, '\n', '<', static_cast<char>(0xff)};
  node.setParam(key + "/binary", XmlRpc::XmlRpcValue(bytes, sizeof bytes));
  say("done");
}

// Prints the value of `--key` as XML-RPC.
static void getParameter(const Options& options) {
  ros::NodeHandle node;
  XmlRpc::XmlRpcValue value;
  bool found = node.getParam(options.text("key"), value);
  say(found ? "value " + value.toXml() : "no value");
}

// Prints `--key` after each change, with a read that subscribes at the master.
static void watchParameter(const Options& options) {
  ros::NodeHandle node;
  std::string key = options.text("key"), last = "?";
  say("ready");
  while (ros::ok()) {
    std::string value = "none";
    node.getParamCached(key, value);
    if (value != last) say("param " + value);
    last = value;
    ros::spinOnce();
    ros::WallDuration(0.02).sleep();
  }
}

static const std::map<std::string, std::function<void(const Options&)>> roles = {
    {"pub", publish},
    {"more", publishMore},
    {"sub", subscribe},
    {"serve", serve},
    {"call", call},
    {"setparams", setParameters},
    {"getparam", getParameter},
    {"watchparam", watchParameter},
    {"actionserver", actionServer},
    {"actionclient", actionClient},
};

int main(int argc, char** argv) {
  ros::init(argc, argv, "node");
  std::vector<std::string> words(argv + 2, argv + argc);
  ros::start();
  say("node " + ros::this_node::getName());
  // The first line for rosout makes roscpp subscribe to a parameter. If this node did so only during
  // its shutdown by a node of the same name, the master would take this node for the newer.
  ROS_INFO("started");
  roles.at(argv[1])(Options(words));
  // In static destructors, the shutdown would dead-lock with a shutdown by SIGINT.
  ros::shutdown();
}
