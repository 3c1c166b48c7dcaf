;;;; Small roslisp nodes, one for each role:
;;;;     node ROLE [--option value]... [__name:=NAME]
;;;; The arguments and the printed lines are those of the rospy and roscpp nodes. To build it:
;;;;     sbcl --non-interactive --no-userinit --load node.lisp --eval '(node::build)'

(require :asdf)

;; Without this folder roslisp waits for ever when it is compiled.
(ensure-directories-exist (merge-pathnames ".ros/" (user-homedir-pathname)))
(asdf:initialize-source-registry
 '(:source-registry
   (:tree "/usr/share/roslisp/")
   (:tree "/usr/share/common-lisp/ros/")
   :inherit-configuration))
(asdf:load-systems :roslisp :std_msgs-msg :topic_tools-srv)

(defpackage :node
  (:use :cl :roslisp))

(in-package :node)

(defparameter *alphabet* "abcdefghijklmnopqrstuvwxyz")
(defvar *output-lock* (sb-thread:make-mutex))

;; roslisp does not start where the master has no parameter at all; this one changes nothing.
(defparameter *parameter* "_debug/level:=info")

(defun words ()
  "The words of the command line that are not for the library."
  (remove-if (lambda (word) (search ":=" word)) (rest sb-ext:*posix-argv*)))

(defun option (name &optional default)
  (or (second (member (format nil "--~a" name) (words) :test #'string=)) default))

(defun number-option (name default)
  (let ((text (option name)))
    (if text (read-from-string text) default)))

(defun say (&rest words)
  (sb-thread:with-mutex (*output-lock*)
    (format t "~{~a~^ ~}~%" words)
    (finish-output)))

(defun payload (word number size)
  "`word number` filled up to SIZE characters."
  (let* ((head (format nil "~a ~d " word number))
         (tail (make-string (max 0 (- size (length head))))))
    (dotimes (i (length tail))
      (setf (char tail i) (char *alphabet* (mod i (length *alphabet*)))))
    (concatenate 'string head tail)))

(defun crc32 (text)
  (let ((crc #xffffffff))
    (declare (type (unsigned-byte 32) crc))
    (loop for character across text
          do (setf crc (logxor crc (char-code character)))
             (loop repeat 8
                   do (setf crc (logxor (ash crc -1) (if (logtest crc 1) #xedb88320 0)))))
    (logxor crc #xffffffff)))

(defun description (text)
  "What identifies a payload: its first two words, its size and its checksum."
  ;; A string of roslisp has one character for each byte of the message.
  (let* ((first-space (position #\Space text))
         (second-space (position #\Space text :start (1+ first-space))))
    (multiple-value-bind (seconds microseconds) (sb-ext:get-time-of-day)
      (format nil "~a size ~d crc ~(~8,'0x~) at ~d.~3,'0d"
              (subseq text 0 second-space) (length text) (crc32 text)
              seconds (floor microseconds 1000)))))

(defun running-p ()
  (eq (node-status) :running))

(defun spin ()
  "Waits for the end, which may also come by the slave API."
  (spin-until (not (running-p)) 0.05))

(defun repeat-at-rate (count function)
  "Calls the function with 0, 1, 2... as long as the node runs."
  (let ((number 0))
    (loop-at-most-every (/ (number-option "rate" 20))
      (unless (and (< number count) (running-p))
        (return))
      (funcall function number)
      (incf number))))

(defun publish-texts ()
  (let ((publication (advertise (option "topic") "std_msgs/String"))
        (word (option "word" "hello"))
        (size (number-option "size" 0)))
    (say "ready")
    (repeat-at-rate
     (number-option "count" 1e9)
     (lambda (number)
       (let ((text (payload word number size)))
         (publish publication (make-instance 'std_msgs-msg:String :data text))
         (say "sent" (description text)))))
    (spin)))

(defun print-texts ()
  (subscribe (option "topic") "std_msgs/String"
             (lambda (message) (say "got" (description (std_msgs-msg:data message)))))
  (say "ready")
  (spin))

(defun serve ()
  (register-service-fn
   (option "service")
   (lambda (request)
     (let ((text (msg-slot-value request :topic)))
       (say "request" (description text))
       (make-instance 'topic_tools-srv:MuxSelect-response
                      :prev_topic (concatenate 'string "echo " text))))
   'topic_tools-srv:MuxSelect)
  (say "ready")
  (spin))

(defun call ()
  (let ((service (option "service"))
        (size (number-option "size" 0))
        (persistent-p (plusp (number-option "persistent" 0)))
        (connection nil))
    (flet ((ask (text)
             (unless persistent-p
               (return-from ask (call-service service "topic_tools/MuxSelect" :topic text)))
             (unless connection
               (setf connection (make-instance 'persistent-service
                                               :service-name service
                                               :service-type "topic_tools/MuxSelect")))
             (call-persistent-service connection :topic text))
           (drop-connection ()
             (when connection
               (close-persistent-service connection)
               (setf connection nil))))
      (say "waiting")
      (unless (wait-for-service service (number-option "patience" 30))
        (error "There is no service ~a." service))
      (repeat-at-rate
       (number-option "count" 1)
       (lambda (number)
         (handler-case
             (let ((reply (msg-slot-value (ask (payload "ask" number size)) :prev_topic)))
               (say "reply" (description (subseq reply (length "echo ")))))
           ;; What the master refuses is no ERROR of Lisp.
           ((or error roslisp::ros-rpc-error) (problem)
             (say "failed" number (substitute #\Space #\Newline (princ-to-string problem)))
             (drop-connection)))))
      (say "done"))))

(defun read-json (text)
  "Reads a boolean, or a number or a string without \\n and the like."
  (cond ((string= text "true") t)
        ((string= text "false") nil)
        (t (read-from-string text))))

(defun json (value)
  (case value
    ((t) "true")
    ((nil) "false")
    (t (prin1-to-string value))))

(defun set-parameter ()
  (set-param (option "key") (read-json (option "json")))
  (say "done"))

(defun get-parameter ()
  (say "value" (json (get-param (option "key")))))

(defparameter *roles*
  '(("pub" . publish-texts)
    ("sub" . print-texts)
    ("serve" . serve)
    ("call" . call)
    ("setparam" . set-parameter)
    ("getparam" . get-parameter)))

(defun main ()
  (sb-ext:disable-debugger)
  (setf roslisp::*debug-stream* *error-output*) ; the log is on standard output otherwise
  (setf *read-default-float-format* 'double-float) ; parameters are single-float otherwise
  ;; As SIGTERM, which unwinds the main thread and so shuts the node down.
  (sb-sys:enable-interrupt sb-unix:sigint #'sb-unix::sigterm-handler)
  (with-ros-node ("node" :cmd-line-args (cons *parameter* (rest sb-ext:*posix-argv*)))
    (say "node" *ros-node-name*)
    (funcall (cdr (assoc (first (words)) *roles* :test #'string=))))
  (sb-ext:exit))

(defun build ()
  (sb-ext:save-lisp-and-die "node" :executable t :toplevel #'main :save-runtime-options t))
