// The action roles of the C++ test nodes.
#include <actionlib/TwoIntsAction.h>
#include <actionlib/client/simple_action_client.h>
#include <actionlib/server/simple_action_server.h>
#include <ros/ros.h>

#include "node.hpp"

// Adds two integers, unless preempted before `--seconds` are over.
void actionServer(const Options& options) {
  ros::NodeHandle node;
  typedef actionlib::SimpleActionServer<actionlib::TwoIntsAction> Server;
  Server* server = nullptr;
  double seconds = options.number("seconds", 0.3);
  Server instance(
      node, options.text("action"),
      [&](const actionlib::TwoIntsGoalConstPtr& goal) {
        say("goal " + std::to_string(goal->a) + " " + std::to_string(goal->b));
        ros::WallTime end = ros::WallTime::now() + ros::WallDuration(seconds);
        while (ros::WallTime::now() < end) {
          server->publishFeedback(actionlib::TwoIntsFeedback());
          if (server->isPreemptRequested()) {
            say("preempted");
            server->setPreempted();
            return;
          }
          ros::WallDuration(0.1).sleep();
        }
        actionlib::TwoIntsResult result;
        result.sum = goal->a + goal->b;
        server->setSucceeded(result);
      },
      false);
  server = &instance;
  server->start();
  say("ready");
  ros::spin();
}

// actionlib_msgs/GoalStatus numbers, which rospy's client prints.
static int status(const actionlib::SimpleClientGoalState& state) {
  if (state == actionlib::SimpleClientGoalState::SUCCEEDED) return 3;
  if (state == actionlib::SimpleClientGoalState::PREEMPTED) return 2;
  return -1;
}

// Sends a goal; with `--cancel 1` cancels after feedback, only once the status has the goal. Before,
// an older status may arrive, and a client that has cancelled would take the goal for lost.
void actionClient(const Options& options) {
  typedef actionlib::SimpleActionClient<actionlib::TwoIntsAction> Client;
  Client client(options.text("action"), true);
  if (!client.waitForServer(ros::Duration(20))) {
    say("no server");
    return;
  }
  bool cancel = options.number("cancel", 0) > 0;
  actionlib::TwoIntsGoal goal;
  goal.a = static_cast<int>(options.number("a", 1));
  goal.b = static_cast<int>(options.number("b", 2));
  client.sendGoal(
      goal, Client::SimpleDoneCallback(), Client::SimpleActiveCallback(),
      [&](const actionlib::TwoIntsFeedbackConstPtr&) {
        say("feedback");
        if (cancel && client.getState() == actionlib::SimpleClientGoalState::ACTIVE) {
          client.cancelGoal();
        }
      });
  bool finished = client.waitForResult(ros::Duration(20));
  auto result = client.getResult();
  say("finished " + std::to_string(finished) + " state " +
      std::to_string(status(client.getState())) + " sum " +
      std::to_string(result ? result->sum : 0));
}
