import sys
from tests.ros.lab import Lab
def test_x(lab: Lab):
    lab.node("rospy","c1","pub",name="talker",topic="/chatter").wait_for("^sent")
    lab.node("roscpp","c2","serve",name="server",service="/add").wait_for("^ready")
    lab.node("rospy", "c1", "pub", name="lonely", topic="/l", env={"ROS_IP": "127.0.0.1"}).wait_for("^sent")
    lab.node("roscpp", "out", "sub", name="list", topic="/chatter").wait_for("^got")
    lab.node("roscpp", "out", "sub", name="list2", topic="/l")
    import time; time.sleep(3)
    for a in (["status"],["status","--json"],["doctor"],["health"]):
        p=lab.start("px", sys.executable,"-m","rosproxy",*a); p.wait(30); print(a,p.returncode); print(p.output())
    assert 0
