// A small node for tests, with one role for each run:
//
//	node ROLE [--option value]... __name:=NAME
package main

import (
	"context"
	"encoding/json"
	"errors"
	"fmt"
	"hash/crc32"
	"net"
	"net/url"
	"os"
	"os/signal"
	"strconv"
	"strings"
	"syscall"
	"time"

	"github.com/aler9/goroslib"
	"github.com/aler9/goroslib/pkg/msg"
	"github.com/aler9/goroslib/pkg/msgs/std_msgs"
	"github.com/aler9/goroslib/pkg/prototcp"
)

const alphabet = "abcdefghijklmnopqrstuvwxyz"

// The library derives the service's type and md5sum from these.

type MuxSelectReq struct {
	msg.Package `ros:"topic_tools"`
	Topic       string
}

type MuxSelectRes struct {
	msg.Package `ros:"topic_tools"`
	PrevTopic   string
}

type MuxSelect struct {
	msg.Package `ros:"topic_tools"`
	MuxSelectReq
	MuxSelectRes
}

type options map[string]string

func (o options) text(name, fallback string) string {
	if value, given := o[name]; given {
		return value
	}
	return fallback
}

func (o options) nodeName() string {
	return "/" + o["__name"]
}

func (o options) number(name string, fallback float64) float64 {
	if value, err := strconv.ParseFloat(o[name], 64); err == nil {
		return value
	}
	return fallback
}

func (o options) seconds(name string, fallback float64) time.Duration {
	return time.Duration(o.number(name, fallback) * float64(time.Second))
}

func (o options) period() time.Duration {
	return time.Duration(float64(time.Second) / o.number("rate", 20))
}

// parse keeps `__name` as an option; the other remappings are the library's.
func parse(arguments []string) (role string, opts options) {
	opts = options{"__name": "node"}
	var words []string
	for _, argument := range arguments {
		if left, right, remapping := strings.Cut(argument, ":="); !remapping {
			words = append(words, argument)
		} else if left == "__name" {
			opts[left] = right
		}
	}
	if len(words) > 0 {
		role = words[0]
	}
	for i := 1; i+1 < len(words); i += 2 {
		opts[strings.TrimPrefix(words[i], "--")] = words[i+1]
	}
	return role, opts
}

// say prints a line with a single write, so that lines of several goroutines don't mix.
func say(words ...any) {
	fmt.Println(words...)
}

// payload is `word number` filled up to size characters.
func payload(word string, number, size int) string {
	head := fmt.Sprintf("%s %d ", word, number)
	if size <= len(head) {
		return head
	}
	return head + strings.Repeat(alphabet, size/len(alphabet)+1)[:size-len(head)]
}

func describe(text string) string {
	word, rest, _ := strings.Cut(text, " ")
	number, _, _ := strings.Cut(rest, " ")
	return fmt.Sprintf("%s %s size %d crc %08x at %.3f", word, number, len(text),
		crc32.ChecksumIEEE([]byte(text)), float64(time.Now().UnixMilli())/1000)
}

func publish(ctx context.Context, node *goroslib.Node, opts options) error {
	publisher, err := goroslib.NewPublisher(goroslib.PublisherConf{
		Node:  node,
		Topic: opts.text("topic", ""),
		Msg:   &std_msgs.String{},
	})
	if err != nil {
		return err
	}
	defer publisher.Close()
	say("ready")

	word, size, count := opts.text("word", "hello"), int(opts.number("size", 0)), int(opts.number("count", 1e9))
	rate := node.TimeRate(opts.period())
	for number := 0; number < count && ctx.Err() == nil; number++ {
		text := payload(word, number, size)
		publisher.Write(&std_msgs.String{Data: text})
		say("sent", describe(text))
		wait(ctx, rate.SleepChan())
	}
	<-ctx.Done()
	return nil
}

func subscribe(ctx context.Context, node *goroslib.Node, opts options) error {
	subscriber, err := goroslib.NewSubscriber(goroslib.SubscriberConf{
		Node:     node,
		Topic:    opts.text("topic", ""),
		Callback: func(message *std_msgs.String) { say("got", describe(message.Data)) },
	})
	if err != nil {
		return err
	}
	defer subscriber.Close()
	say("ready")
	<-ctx.Done()
	return nil
}

func serve(ctx context.Context, node *goroslib.Node, opts options) error {
	provider, err := goroslib.NewServiceProvider(goroslib.ServiceProviderConf{
		Node: node,
		Name: opts.text("service", ""),
		Srv:  &MuxSelect{},
		Callback: func(request *MuxSelectReq) (*MuxSelectRes, bool) {
			say("request", describe(request.Topic))
			return &MuxSelectRes{PrevTopic: "echo " + request.Topic}, true
		},
	})
	if err != nil {
		return err
	}
	defer provider.Close()
	say("ready")
	<-ctx.Done()
	return nil
}

func call(ctx context.Context, node *goroslib.Node, opts options) error {
	service := opts.text("service", "")
	say("waiting")
	if err := waitForService(ctx, node, opts); err != nil {
		return err
	}

	persistent := opts.number("persistent", 0) > 0
	size, count := int(opts.number("size", 0)), int(opts.number("count", 1))
	rate := node.TimeRate(opts.period())
	var client *goroslib.ServiceClient
	for number := 0; number < count; number++ {
		if client == nil {
			var err error
			client, err = goroslib.NewServiceClient(goroslib.ServiceClientConf{
				Node: node,
				Name: service,
				Srv:  &MuxSelect{},
			})
			if err != nil {
				return err
			}
		}
		var response MuxSelectRes
		err := client.CallContext(ctx, &MuxSelectReq{Topic: payload("ask", number, size)}, &response)
		// A client keeps its connection; after an error its next call makes a new one.
		if !persistent {
			client.Close()
			client = nil
		}
		if ctx.Err() != nil {
			break
		}
		if err == nil {
			say("reply", describe(strings.TrimPrefix(response.PrevTopic, "echo ")))
		} else {
			say("failed", number, err)
		}
		wait(ctx, rate.SleepChan())
	}
	if client != nil {
		client.Close()
	}
	say("done")
	return nil
}

// waitForService does what rospy's wait_for_service does; the library has nothing for it.
func waitForService(ctx context.Context, node *goroslib.Node, opts options) error {
	service := "/" + strings.TrimPrefix(opts.text("service", ""), "/")
	deadline := time.Now().Add(opts.seconds("patience", 30))
	for {
		err := probe(node, opts.nodeName(), service)
		if err == nil || ctx.Err() != nil {
			return nil
		}
		if time.Now().After(deadline) {
			return fmt.Errorf("waiting for %s: %w", service, err)
		}
		wait(ctx, time.After(100*time.Millisecond))
	}
}

func probe(node *goroslib.Node, nodeName, service string) error {
	services, err := node.MasterGetServices()
	if err != nil {
		return err
	}
	info, found := services[service]
	if !found {
		return errors.New("not registered")
	}
	connection, err := net.DialTimeout("tcp", info.Address, 5*time.Second)
	if err != nil {
		return err
	}
	defer connection.Close()
	connection.SetDeadline(time.Now().Add(5 * time.Second))
	tcpros := prototcp.NewConn(connection)
	err = tcpros.WriteHeader(&struct {
		Callerid, Md5sum, Service string
		Probe                     int
	}{nodeName, "*", service, 1})
	if err != nil {
		return err
	}
	_, err = tcpros.ReadHeaderRaw()
	return err
}

func setParameter(_ context.Context, node *goroslib.Node, opts options) error {
	key, text := opts.text("key", ""), opts.text("json", "")
	decoder := json.NewDecoder(strings.NewReader(text))
	decoder.UseNumber()
	var value any
	err := decoder.Decode(&value)
	if err != nil {
		return err
	}
	switch value := value.(type) {
	case bool:
		err = node.ParamSetBool(key, value)
	case string:
		err = node.ParamSetString(key, value)
	case json.Number:
		if integer, notInteger := strconv.Atoi(value.String()); notInteger == nil {
			err = node.ParamSetInt(key, integer)
		} else if double, notDouble := value.Float64(); notDouble == nil {
			err = node.ParamSetFloat64(key, double)
		} else {
			err = notDouble
		}
	default:
		err = errors.New("the library sets only int, double, bool and string")
	}
	if err == nil {
		say("done")
	}
	return err
}

func getParameter(_ context.Context, node *goroslib.Node, opts options) error {
	value, err := parameter(node, opts.text("key", ""))
	if err != nil {
		return err
	}
	encoded, err := json.Marshal(value)
	if err != nil {
		return err
	}
	text := string(encoded)
	if _, double := value.(float64); double && !strings.ContainsAny(text, ".e") {
		text += ".0"
	}
	say("value", text)
	return nil
}

// parameter tries the types in turn: the library reads only a value whose type is known.
func parameter(node *goroslib.Node, key string) (any, error) {
	if value, err := node.ParamGetBool(key); err == nil {
		return value, nil
	}
	if value, err := node.ParamGetInt(key); err == nil {
		return value, nil
	}
	if value, err := node.ParamGetFloat64(key); err == nil {
		return value, nil
	}
	return node.ParamGetString(key)
}

func wait(ctx context.Context, end <-chan time.Time) {
	select {
	case <-end:
	case <-ctx.Done():
	}
}

func newNode(name string) (*goroslib.Node, error) {
	master, err := url.Parse(os.Getenv("ROS_MASTER_URI"))
	if err != nil {
		return nil, err
	}
	conf := goroslib.NodeConf{
		MasterAddress: master.Host,
		Name:          name,
		Host:          os.Getenv("ROS_HOSTNAME"),
		LogLevel:      goroslib.LogLevelWarn, // lower levels would go to the standard output
	}
	if conf.Host == "" {
		conf.Host = os.Getenv("ROS_IP")
	}
	node, err := goroslib.NewNode(conf)
	if err != nil && conf.Host == "" {
		// The library knows an address of its own only in the master's network.
		conf.Host, _ = os.Hostname()
		node, err = goroslib.NewNode(conf)
	}
	return node, err
}

func run() error {
	roles := map[string]func(context.Context, *goroslib.Node, options) error{
		"pub":      publish,
		"sub":      subscribe,
		"serve":    serve,
		"call":     call,
		"setparam": setParameter,
		"getparam": getParameter,
	}
	name, opts := parse(os.Args[1:])
	role, known := roles[name]
	if !known {
		return fmt.Errorf("no role %q", name)
	}
	ctx, stop := signal.NotifyContext(context.Background(), os.Interrupt, syscall.SIGTERM)
	defer stop()
	node, err := newNode(opts["__name"])
	if err != nil {
		return err
	}
	// Last: a node's Close doesn't wait until its publishers and services are unregistered.
	defer node.Close()
	say("node", opts.nodeName())
	return role(ctx, node, opts)
}

func main() {
	if err := run(); err != nil {
		fmt.Fprintln(os.Stderr, err)
		os.Exit(1)
	}
}
