module node

go 1.18

require github.com/aler9/goroslib v1.2.0

require (
	github.com/gookit/color v1.5.2 // indirect
	github.com/xo/terminfo v0.0.0-20210125001918-ca9a967f8778 // indirect
	golang.org/x/sys v0.5.0 // indirect
)
