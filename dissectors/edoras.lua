-- EDORAS for Wireshark and tshark: CCSDS space packets, cFE, SBN, the EDORAS envelope and ROS 2 messages.
-- Generated from the layouts of edoras-tools; do not edit: edoras wireshark print > edoras.lua
-- Routes of the demos of the EDORAS paper; ROS 2 jazzy.
-- SPDX-License-Identifier: MIT

local DIGEST = "921f70c1856b7c95"
local wanted = os.getenv("EDORAS_LUA")
if wanted and wanted ~= "" and wanted ~= DIGEST then
	return  -- another copy shall be loaded
end
local first, EDORAS = pcall(Proto, "edoras", "EDORAS")
if not first then
	return  -- another copy is loaded: a protocol can be there only once
end

local D = {}
D.layouts = {
	sbn = {
		name = "sbn",
		protocol = "sbn",
		title = "Software Bus Network",
		size = 11,
		fields = {
			{
				abbreviation = "sbn.msg_size",
				name = "msg_size",
				start = 0,
				size = 2,
				kind = "int16",
				doc = "payload bytes; this header is not counted",
			},
			{
				abbreviation = "sbn.msg_type",
				name = "msg_type",
				start = 2,
				size = 1,
				kind = "uint8",
				hex = true,
				names = {
					[0] = "NO_MSG",
					[1] = "SUB",
					[2] = "UNSUB",
					[3] = "APP",
					[4] = "PROTO",
					[160] = "HEARTBEAT",
					[161] = "ANNOUNCE",
					[162] = "DISCONNECT",
				},
				doc = "what the payload is",
			},
			{
				abbreviation = "sbn.processor_id",
				name = "processor_id",
				start = 3,
				size = 4,
				kind = "uint32",
				doc = "the sender's processor",
			},
			{
				abbreviation = "sbn.spacecraft_id",
				name = "spacecraft_id",
				start = 7,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "the sender's spacecraft",
			},
		},
		place = {msg_size = 1, msg_type = 2, processor_id = 3, spacecraft_id = 4},
	},
	sbn_sub = {
		name = "sbn_sub",
		protocol = "sbn",
		title = "SBN Subscriptions",
		size = 50,
		fields = {
			{
				abbreviation = "sbn.sub.ident",
				name = "ident",
				start = 0,
				size = 48,
				kind = "string",
				doc = "$Id of the sender's SBN; another than the receiver's is refused",
			},
			{
				abbreviation = "sbn.sub.count",
				name = "count",
				start = 48,
				size = 2,
				kind = "uint16",
				doc = "entries that follow",
			},
		},
		place = {count = 1, ident = 2},
	},
	sbn_proto = {
		name = "sbn_proto",
		protocol = "sbn",
		title = "SBN Protocol",
		size = 1,
		fields = {
			{
				abbreviation = "sbn.proto.protocol_version",
				name = "protocol_version",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "11 here; another is refused",
			},
		},
		place = {protocol_version = 1},
	},
	robot_command = {
		name = "robot_command",
		protocol = "robot",
		title = "Robot command",
		size = 48,
		little = true,
		fields = {
			{
				abbreviation = "robot.command.linear_x",
				name = "linear_x",
				start = 0,
				size = 8,
				kind = "double",
				doc = "velocity, m/s",
			},
			{
				abbreviation = "robot.command.linear_y",
				name = "linear_y",
				start = 8,
				size = 8,
				kind = "double",
				doc = "velocity, m/s",
			},
			{
				abbreviation = "robot.command.linear_z",
				name = "linear_z",
				start = 16,
				size = 8,
				kind = "double",
				doc = "velocity, m/s",
			},
			{
				abbreviation = "robot.command.angular_x",
				name = "angular_x",
				start = 24,
				size = 8,
				kind = "double",
				doc = "velocity, rad/s",
			},
			{
				abbreviation = "robot.command.angular_y",
				name = "angular_y",
				start = 32,
				size = 8,
				kind = "double",
				doc = "velocity, rad/s",
			},
			{
				abbreviation = "robot.command.angular_z",
				name = "angular_z",
				start = 40,
				size = 8,
				kind = "double",
				doc = "velocity, rad/s",
			},
		},
		place = {},
	},
	robot_pose = {
		name = "robot_pose",
		protocol = "robot",
		title = "Robot pose",
		size = 56,
		little = true,
		fields = {
			{
				abbreviation = "robot.pose.position_x",
				name = "position_x",
				start = 0,
				size = 8,
				kind = "double",
				doc = "m; an arm's joints 1 to 3, rad",
			},
			{
				abbreviation = "robot.pose.position_y",
				name = "position_y",
				start = 8,
				size = 8,
				kind = "double",
				doc = "m; an arm's joints 1 to 3, rad",
			},
			{
				abbreviation = "robot.pose.position_z",
				name = "position_z",
				start = 16,
				size = 8,
				kind = "double",
				doc = "m; an arm's joints 1 to 3, rad",
			},
			{
				abbreviation = "robot.pose.orientation_x",
				name = "orientation_x",
				start = 24,
				size = 8,
				kind = "double",
				doc = "quaternion; an arm's joints 4 to 7, rad",
			},
			{
				abbreviation = "robot.pose.orientation_y",
				name = "orientation_y",
				start = 32,
				size = 8,
				kind = "double",
				doc = "quaternion; an arm's joints 4 to 7, rad",
			},
			{
				abbreviation = "robot.pose.orientation_z",
				name = "orientation_z",
				start = 40,
				size = 8,
				kind = "double",
				doc = "quaternion; an arm's joints 4 to 7, rad",
			},
			{
				abbreviation = "robot.pose.orientation_w",
				name = "orientation_w",
				start = 48,
				size = 8,
				kind = "double",
				doc = "quaternion; an arm's joints 4 to 7, rad",
			},
		},
		place = {},
	},
	robot_state = {
		name = "robot_state",
		protocol = "robot",
		title = "Robot state",
		size = 64,
		little = true,
		fields = {
			{
				abbreviation = "robot.state.position_x",
				name = "position_x",
				start = 0,
				size = 8,
				kind = "double",
				doc = "m; an arm's joints 1 to 3, rad",
			},
			{
				abbreviation = "robot.state.position_y",
				name = "position_y",
				start = 8,
				size = 8,
				kind = "double",
				doc = "m; an arm's joints 1 to 3, rad",
			},
			{
				abbreviation = "robot.state.position_z",
				name = "position_z",
				start = 16,
				size = 8,
				kind = "double",
				doc = "m; an arm's joints 1 to 3, rad",
			},
			{
				abbreviation = "robot.state.orientation_x",
				name = "orientation_x",
				start = 24,
				size = 8,
				kind = "double",
				doc = "quaternion; an arm's joints 4 to 7, rad",
			},
			{
				abbreviation = "robot.state.orientation_y",
				name = "orientation_y",
				start = 32,
				size = 8,
				kind = "double",
				doc = "quaternion; an arm's joints 4 to 7, rad",
			},
			{
				abbreviation = "robot.state.orientation_z",
				name = "orientation_z",
				start = 40,
				size = 8,
				kind = "double",
				doc = "quaternion; an arm's joints 4 to 7, rad",
			},
			{
				abbreviation = "robot.state.orientation_w",
				name = "orientation_w",
				start = 48,
				size = 8,
				kind = "double",
				doc = "quaternion; an arm's joints 4 to 7, rad",
			},
			{
				abbreviation = "robot.state.stamp_seconds",
				name = "stamp_seconds",
				start = 56,
				size = 4,
				kind = "int32",
				doc = "the robot's time",
			},
			{
				abbreviation = "robot.state.stamp_nanoseconds",
				name = "stamp_nanoseconds",
				start = 60,
				size = 4,
				kind = "uint32",
				doc = "the robot's time: beyond its seconds",
			},
		},
		place = {stamp_seconds = 1, stamp_nanoseconds = 2},
	},
	tm_frame = {
		name = "tm_frame",
		protocol = "frames",
		title = "CCSDS TM Transfer Frame",
		size = 6,
		fields = {
			{
				abbreviation = "frames.tm_frame.transfer_frame_version_number",
				name = "transfer_frame_version_number",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 49152,
				doc = "0 (132.0-B 4.1.2.2.2)",
			},
			{
				abbreviation = "frames.tm_frame.spacecraft_id",
				name = "spacecraft_id",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 16368,
				hex = true,
				doc = "of the spacecraft (132.0-B 4.1.2.2.3)",
			},
			{
				abbreviation = "frames.tm_frame.virtual_channel_id",
				name = "virtual_channel_id",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 14,
				doc = "the channel of the frame (132.0-B 4.1.2.3)",
			},
			{
				abbreviation = "frames.tm_frame.ocf_flag",
				name = "ocf_flag",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 1,
				doc = "an operational control field follows the data (132.0-B 4.1.2.4)",
			},
			{
				abbreviation = "frames.tm_frame.master_channel_frame_count",
				name = "master_channel_frame_count",
				start = 2,
				size = 1,
				kind = "uint8",
				doc = "counts all frames of the spacecraft (132.0-B 4.1.2.5)",
			},
			{
				abbreviation = "frames.tm_frame.virtual_channel_frame_count",
				name = "virtual_channel_frame_count",
				start = 3,
				size = 1,
				kind = "uint8",
				doc = "counts the frames of the channel (132.0-B 4.1.2.6)",
			},
			{
				abbreviation = "frames.tm_frame.secondary_header_flag",
				name = "secondary_header_flag",
				start = 4,
				size = 2,
				kind = "uint16",
				mask = 32768,
				doc = "a secondary header follows (132.0-B 4.1.2.7.2)",
			},
			{
				abbreviation = "frames.tm_frame.synchronization_flag",
				name = "synchronization_flag",
				start = 4,
				size = 2,
				kind = "uint16",
				mask = 16384,
				doc = "0: packets; 1: other data (132.0-B 4.1.2.7.3)",
			},
			{
				abbreviation = "frames.tm_frame.packet_order_flag",
				name = "packet_order_flag",
				start = 4,
				size = 2,
				kind = "uint16",
				mask = 8192,
				doc = "0 with packets (132.0-B 4.1.2.7.4)",
			},
			{
				abbreviation = "frames.tm_frame.segment_length_id",
				name = "segment_length_id",
				start = 4,
				size = 2,
				kind = "uint16",
				mask = 6144,
				doc = "3 with packets (132.0-B 4.1.2.7.5)",
			},
			{
				abbreviation = "frames.tm_frame.first_header_pointer",
				name = "first_header_pointer",
				start = 4,
				size = 2,
				kind = "uint16",
				mask = 2047,
				hex = true,
				names = {[2046] = "only idle data", [2047] = "no packet starts"},
				special = {5, 11},
				doc = "where in the data the first packet starts (132.0-B 4.1.2.7.6)",
			},
		},
		place = {
			transfer_frame_version_number = 1,
			spacecraft_id = 2,
			virtual_channel_id = 3,
			ocf_flag = 4,
			master_channel_frame_count = 5,
			virtual_channel_frame_count = 6,
			secondary_header_flag = 7,
			synchronization_flag = 8,
			packet_order_flag = 9,
			segment_length_id = 10,
			first_header_pointer = 11,
		},
	},
	aos_frame = {
		name = "aos_frame",
		protocol = "frames",
		title = "CCSDS AOS Transfer Frame",
		size = 6,
		fields = {
			{
				abbreviation = "frames.aos_frame.transfer_frame_version_number",
				name = "transfer_frame_version_number",
				start = 0,
				size = 1,
				kind = "uint8",
				mask = 192,
				doc = "1 (732.0-B 4.1.2.2.2)",
			},
			{
				abbreviation = "frames.aos_frame.spacecraft_id",
				name = "spacecraft_id",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 16320,
				hex = true,
				doc = "of the spacecraft, its 8 low bits (732.0-B 4.1.2.2.3)",
			},
			{
				abbreviation = "frames.aos_frame.virtual_channel_id",
				name = "virtual_channel_id",
				start = 1,
				size = 1,
				kind = "uint8",
				mask = 63,
				names = {[63] = "idle frames"},
				special = {2, 6},
				doc = "the channel of the frame (732.0-B 4.1.2.3)",
			},
			{
				abbreviation = "frames.aos_frame.virtual_channel_frame_count",
				name = "virtual_channel_frame_count",
				start = 2,
				size = 3,
				kind = "uint24",
				doc = "counts the frames of the channel (732.0-B 4.1.2.4)",
			},
			{
				abbreviation = "frames.aos_frame.replay_flag",
				name = "replay_flag",
				start = 5,
				size = 1,
				kind = "uint8",
				mask = 128,
				doc = "played back (732.0-B 4.1.2.5.2)",
			},
			{
				abbreviation = "frames.aos_frame.frame_count_usage_flag",
				name = "frame_count_usage_flag",
				start = 5,
				size = 1,
				kind = "uint8",
				mask = 64,
				doc = "the cycle is counted, too (732.0-B 4.1.2.5.3)",
			},
			{
				abbreviation = "frames.aos_frame.spacecraft_id_high",
				name = "spacecraft_id_high",
				start = 5,
				size = 1,
				kind = "uint8",
				mask = 48,
				doc = "further bits of the spacecraft since issue 4; 0 before",
			},
			{
				abbreviation = "frames.aos_frame.frame_count_cycle",
				name = "frame_count_cycle",
				start = 5,
				size = 1,
				kind = "uint8",
				mask = 15,
				doc = "how often the count began anew (732.0-B 4.1.2.5.5)",
			},
		},
		place = {
			transfer_frame_version_number = 1,
			spacecraft_id = 2,
			virtual_channel_id = 3,
			virtual_channel_frame_count = 4,
			replay_flag = 5,
			frame_count_usage_flag = 6,
			spacecraft_id_high = 7,
			frame_count_cycle = 8,
		},
	},
	tc_frame = {
		name = "tc_frame",
		protocol = "frames",
		title = "CCSDS TC Transfer Frame",
		size = 5,
		fields = {
			{
				abbreviation = "frames.tc_frame.transfer_frame_version_number",
				name = "transfer_frame_version_number",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 49152,
				doc = "0 (232.0-B 4.1.2.2.2)",
			},
			{
				abbreviation = "frames.tc_frame.bypass_flag",
				name = "bypass_flag",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 8192,
				doc = "1 (Type-B): not counted (232.0-B 4.1.2.2.3.1)",
			},
			{
				abbreviation = "frames.tc_frame.control_command_flag",
				name = "control_command_flag",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 4096,
				doc = "1: a command to the frame's receiver itself (232.0-B 4.1.2.2.3.2)",
			},
			{
				abbreviation = "frames.tc_frame.reserved",
				name = "reserved",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 3072,
				doc = "0",
			},
			{
				abbreviation = "frames.tc_frame.spacecraft_id",
				name = "spacecraft_id",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 1023,
				hex = true,
				doc = "of the spacecraft (232.0-B 4.1.2.4)",
			},
			{
				abbreviation = "frames.tc_frame.virtual_channel_id",
				name = "virtual_channel_id",
				start = 2,
				size = 2,
				kind = "uint16",
				mask = 64512,
				doc = "the channel of the frame (232.0-B 4.1.2.5)",
			},
			{
				abbreviation = "frames.tc_frame.frame_length",
				name = "frame_length",
				start = 2,
				size = 2,
				kind = "uint16",
				mask = 1023,
				doc = "bytes of the whole frame, less 1 (232.0-B 4.1.2.6)",
			},
			{
				abbreviation = "frames.tc_frame.frame_sequence_number",
				name = "frame_sequence_number",
				start = 4,
				size = 1,
				kind = "uint8",
				doc = "counts the Type-A frames of the channel (232.0-B 4.1.2.7)",
			},
		},
		place = {
			transfer_frame_version_number = 1,
			bypass_flag = 2,
			control_command_flag = 3,
			reserved = 4,
			spacecraft_id = 5,
			virtual_channel_id = 6,
			frame_length = 7,
			frame_sequence_number = 8,
		},
	},
	tm_secondary = {
		name = "tm_secondary",
		protocol = "frames",
		title = "TM Secondary Header",
		size = 1,
		fields = {
			{
				abbreviation = "frames.tm_secondary.version_number",
				name = "version_number",
				start = 0,
				size = 1,
				kind = "uint8",
				mask = 192,
				doc = "0 (132.0-B 4.1.3.2.2)",
			},
			{
				abbreviation = "frames.tm_secondary.secondary_header_length",
				name = "secondary_header_length",
				start = 0,
				size = 1,
				kind = "uint8",
				mask = 63,
				doc = "bytes that follow this one (132.0-B 4.1.3.2.3)",
			},
		},
		place = {version_number = 1, secondary_header_length = 2},
	},
	aos_packets = {
		name = "aos_packets",
		protocol = "frames",
		title = "AOS Packet Zone",
		size = 2,
		fields = {
			{
				abbreviation = "frames.aos_packets.reserved",
				name = "reserved",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 63488,
				doc = "0",
			},
			{
				abbreviation = "frames.aos_packets.first_header_pointer",
				name = "first_header_pointer",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 2047,
				hex = true,
				names = {[2046] = "only idle data", [2047] = "no packet starts"},
				special = {5, 11},
				doc = "where in the data the first packet starts (732.0-B 4.1.4.2.2.3)",
			},
		},
		place = {reserved = 1, first_header_pointer = 2},
	},
	tc_segment = {
		name = "tc_segment",
		protocol = "frames",
		title = "TC Segment",
		size = 1,
		fields = {
			{
				abbreviation = "frames.tc_segment.segment_sequence_flags",
				name = "segment_sequence_flags",
				start = 0,
				size = 1,
				kind = "uint8",
				mask = 192,
				names = {[0] = "continuing", [1] = "first", [2] = "last", [3] = "whole"},
				doc = "which part of a packet it is (232.0-B 4.1.3.2.2.2)",
			},
			{
				abbreviation = "frames.tc_segment.map_id",
				name = "map_id",
				start = 0,
				size = 1,
				kind = "uint8",
				mask = 63,
				doc = "parts of one packet have the same (232.0-B 4.1.3.2.2.3)",
			},
		},
		place = {segment_sequence_flags = 1, map_id = 2},
	},
	fprime = {
		name = "fprime",
		protocol = "fprime",
		title = "F Prime Frame",
		size = 8,
		fields = {
			{
				abbreviation = "fprime.start_word",
				name = "start_word",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "always 0xdeadbeef",
			},
			{
				abbreviation = "fprime.length",
				name = "length",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "bytes of the packet",
			},
		},
		place = {start_word = 1, length = 2},
	},
	fprime_tc = {
		name = "fprime_tc",
		protocol = "fprime",
		title = "CCSDS TC Transfer Frame",
		size = 5,
		fields = {
			{
				abbreviation = "fprime.tc.transfer_frame_version_number",
				name = "transfer_frame_version_number",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 49152,
				doc = "0 (232.0-B 4.1.2.2.2)",
			},
			{
				abbreviation = "fprime.tc.bypass_flag",
				name = "bypass_flag",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 8192,
				doc = "1 (Type-B): not counted (232.0-B 4.1.2.2.3.1)",
			},
			{
				abbreviation = "fprime.tc.control_command_flag",
				name = "control_command_flag",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 4096,
				doc = "1: a command to the frame's receiver itself (232.0-B 4.1.2.2.3.2)",
			},
			{
				abbreviation = "fprime.tc.reserved",
				name = "reserved",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 3072,
				doc = "0",
			},
			{
				abbreviation = "fprime.tc.spacecraft_id",
				name = "spacecraft_id",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 1023,
				hex = true,
				doc = "of the spacecraft (232.0-B 4.1.2.4)",
			},
			{
				abbreviation = "fprime.tc.virtual_channel_id",
				name = "virtual_channel_id",
				start = 2,
				size = 2,
				kind = "uint16",
				mask = 64512,
				doc = "the channel of the frame (232.0-B 4.1.2.5)",
			},
			{
				abbreviation = "fprime.tc.frame_length",
				name = "frame_length",
				start = 2,
				size = 2,
				kind = "uint16",
				mask = 1023,
				doc = "bytes of the whole frame, less 1 (232.0-B 4.1.2.6)",
			},
			{
				abbreviation = "fprime.tc.frame_sequence_number",
				name = "frame_sequence_number",
				start = 4,
				size = 1,
				kind = "uint8",
				doc = "counts the Type-A frames of the channel (232.0-B 4.1.2.7)",
			},
		},
		place = {
			transfer_frame_version_number = 1,
			bypass_flag = 2,
			control_command_flag = 3,
			reserved = 4,
			spacecraft_id = 5,
			virtual_channel_id = 6,
			frame_length = 7,
			frame_sequence_number = 8,
		},
	},
	fprime_tm = {
		name = "fprime_tm",
		protocol = "fprime",
		title = "CCSDS TM Transfer Frame",
		size = 6,
		fields = {
			{
				abbreviation = "fprime.tm.transfer_frame_version_number",
				name = "transfer_frame_version_number",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 49152,
				doc = "0 (132.0-B 4.1.2.2.2)",
			},
			{
				abbreviation = "fprime.tm.spacecraft_id",
				name = "spacecraft_id",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 16368,
				hex = true,
				doc = "of the spacecraft (132.0-B 4.1.2.2.3)",
			},
			{
				abbreviation = "fprime.tm.virtual_channel_id",
				name = "virtual_channel_id",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 14,
				doc = "the channel of the frame (132.0-B 4.1.2.3)",
			},
			{
				abbreviation = "fprime.tm.ocf_flag",
				name = "ocf_flag",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 1,
				doc = "an operational control field follows the data (132.0-B 4.1.2.4)",
			},
			{
				abbreviation = "fprime.tm.master_channel_frame_count",
				name = "master_channel_frame_count",
				start = 2,
				size = 1,
				kind = "uint8",
				doc = "counts all frames of the spacecraft (132.0-B 4.1.2.5)",
			},
			{
				abbreviation = "fprime.tm.virtual_channel_frame_count",
				name = "virtual_channel_frame_count",
				start = 3,
				size = 1,
				kind = "uint8",
				doc = "counts the frames of the channel (132.0-B 4.1.2.6)",
			},
			{
				abbreviation = "fprime.tm.secondary_header_flag",
				name = "secondary_header_flag",
				start = 4,
				size = 2,
				kind = "uint16",
				mask = 32768,
				doc = "a secondary header follows (132.0-B 4.1.2.7.2)",
			},
			{
				abbreviation = "fprime.tm.synchronization_flag",
				name = "synchronization_flag",
				start = 4,
				size = 2,
				kind = "uint16",
				mask = 16384,
				doc = "0: packets; 1: other data (132.0-B 4.1.2.7.3)",
			},
			{
				abbreviation = "fprime.tm.packet_order_flag",
				name = "packet_order_flag",
				start = 4,
				size = 2,
				kind = "uint16",
				mask = 8192,
				doc = "0 with packets (132.0-B 4.1.2.7.4)",
			},
			{
				abbreviation = "fprime.tm.segment_length_id",
				name = "segment_length_id",
				start = 4,
				size = 2,
				kind = "uint16",
				mask = 6144,
				doc = "3 with packets (132.0-B 4.1.2.7.5)",
			},
			{
				abbreviation = "fprime.tm.first_header_pointer",
				name = "first_header_pointer",
				start = 4,
				size = 2,
				kind = "uint16",
				mask = 2047,
				hex = true,
				names = {[2046] = "only idle data", [2047] = "no packet starts"},
				special = {5, 11},
				doc = "where in the data the first packet starts (132.0-B 4.1.2.7.6)",
			},
		},
		place = {
			transfer_frame_version_number = 1,
			spacecraft_id = 2,
			virtual_channel_id = 3,
			ocf_flag = 4,
			master_channel_frame_count = 5,
			virtual_channel_frame_count = 6,
			secondary_header_flag = 7,
			synchronization_flag = 8,
			packet_order_flag = 9,
			segment_length_id = 10,
			first_header_pointer = 11,
		},
	},
	fprime_space_packet = {
		name = "fprime_space_packet",
		protocol = "fprime",
		title = "CCSDS Space Packet",
		size = 6,
		fields = {
			{
				abbreviation = "fprime.space_packet.packet_version_number",
				name = "packet_version_number",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 57344,
				doc = "always 0 on this link (133.0-B 4.1.3.2)",
			},
			{
				abbreviation = "fprime.space_packet.packet_type",
				name = "packet_type",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 4096,
				names = {[0] = "telemetry", [1] = "telecommand"},
				doc = "1 to F Prime (133.0-B 4.1.3.3.2)",
			},
			{
				abbreviation = "fprime.space_packet.secondary_header_flag",
				name = "secondary_header_flag",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 2048,
				doc = "0: no other header follows (133.0-B 4.1.3.3.3)",
			},
			{
				abbreviation = "fprime.space_packet.apid",
				name = "apid",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 2047,
				hex = true,
				doc = "the packet type again; 0x7ff: idle (133.0-B 4.1.3.3.4)",
			},
			{
				abbreviation = "fprime.space_packet.sequence_flags",
				name = "sequence_flags",
				start = 2,
				size = 2,
				kind = "uint16",
				mask = 49152,
				names = {[0] = "continuation", [1] = "first", [2] = "last", [3] = "unsegmented"},
				doc = "3: a whole packet (133.0-B 4.1.3.4.2)",
			},
			{
				abbreviation = "fprime.space_packet.packet_sequence_count",
				name = "packet_sequence_count",
				start = 2,
				size = 2,
				kind = "uint16",
				mask = 16383,
				doc = "counts the packets of one APID (133.0-B 4.1.3.4.3)",
			},
			{
				abbreviation = "fprime.space_packet.packet_data_length",
				name = "packet_data_length",
				start = 4,
				size = 2,
				kind = "uint16",
				doc = "bytes of the whole packet, less 7 (133.0-B 4.1.3.5)",
			},
		},
		place = {
			packet_version_number = 1,
			packet_type = 2,
			secondary_header_flag = 3,
			apid = 4,
			sequence_flags = 5,
			packet_sequence_count = 6,
			packet_data_length = 7,
		},
	},
	fprime_packet = {
		name = "fprime_packet",
		protocol = "fprime",
		title = "F Prime Packet",
		size = 2,
		fields = {
			{
				abbreviation = "fprime.packet.packet_type",
				name = "packet_type",
				start = 0,
				size = 2,
				kind = "uint16",
				names = {
					[0] = "command",
					[1] = "telemetry",
					[2] = "event",
					[3] = "file",
					[4] = "packetized telemetry",
					[5] = "data product",
					[6] = "idle",
					[7] = "parameter",
					[254] = "handshake",
				},
				doc = "what it holds",
			},
		},
		place = {packet_type = 1},
	},
	fprime_command = {
		name = "fprime_command",
		protocol = "fprime",
		title = "F Prime Command",
		size = 4,
		fields = {
			{
				abbreviation = "fprime.command.opcode",
				name = "opcode",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "of the command",
			},
		},
		place = {opcode = 1},
	},
	fprime_channel = {
		name = "fprime_channel",
		protocol = "fprime",
		title = "F Prime Channel",
		size = 15,
		fields = {
			{
				abbreviation = "fprime.channel.channel_id",
				name = "channel_id",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "of the channel",
			},
			{
				abbreviation = "fprime.channel.time_base",
				name = "time_base",
				start = 4,
				size = 2,
				kind = "uint16",
				names = {
					[0] = "none",
					[1] = "processor",
					[2] = "workstation",
					[3] = "spacecraft",
					[65535] = "any",
				},
				doc = "which clock",
			},
			{
				abbreviation = "fprime.channel.time_context",
				name = "time_context",
				start = 6,
				size = 1,
				kind = "uint8",
				doc = "free for the mission",
			},
			{
				abbreviation = "fprime.channel.seconds",
				name = "seconds",
				start = 7,
				size = 4,
				kind = "uint32",
				doc = "of that clock",
			},
			{
				abbreviation = "fprime.channel.microseconds",
				name = "microseconds",
				start = 11,
				size = 4,
				kind = "uint32",
				doc = "beyond its seconds",
			},
		},
		place = {channel_id = 1, time_base = 2, time_context = 3, seconds = 4, microseconds = 5},
	},
	fprime_event = {
		name = "fprime_event",
		protocol = "fprime",
		title = "F Prime Event",
		size = 15,
		fields = {
			{
				abbreviation = "fprime.event.event_id",
				name = "event_id",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "of the event",
			},
			{
				abbreviation = "fprime.event.time_base",
				name = "time_base",
				start = 4,
				size = 2,
				kind = "uint16",
				names = {
					[0] = "none",
					[1] = "processor",
					[2] = "workstation",
					[3] = "spacecraft",
					[65535] = "any",
				},
				doc = "which clock",
			},
			{
				abbreviation = "fprime.event.time_context",
				name = "time_context",
				start = 6,
				size = 1,
				kind = "uint8",
				doc = "free for the mission",
			},
			{
				abbreviation = "fprime.event.seconds",
				name = "seconds",
				start = 7,
				size = 4,
				kind = "uint32",
				doc = "of that clock",
			},
			{
				abbreviation = "fprime.event.microseconds",
				name = "microseconds",
				start = 11,
				size = 4,
				kind = "uint32",
				doc = "beyond its seconds",
			},
		},
		place = {event_id = 1, time_base = 2, time_context = 3, seconds = 4, microseconds = 5},
	},
	fprime_file = {
		name = "fprime_file",
		protocol = "fprime",
		title = "F Prime File",
		size = 5,
		fields = {
			{
				abbreviation = "fprime.file.kind",
				name = "kind",
				start = 0,
				size = 1,
				kind = "uint8",
				names = {[0] = "start", [1] = "data", [2] = "end", [3] = "cancel"},
				doc = "part of the transfer",
			},
			{
				abbreviation = "fprime.file.sequence_index",
				name = "sequence_index",
				start = 1,
				size = 4,
				kind = "uint32",
				doc = "counts the packets of a transfer",
			},
		},
		place = {kind = 1, sequence_index = 2},
	},
	fprime_telemetry = {
		name = "fprime_telemetry",
		protocol = "fprime",
		title = "F Prime Telemetry Packet",
		size = 13,
		fields = {
			{
				abbreviation = "fprime.telemetry.packet_id",
				name = "packet_id",
				start = 0,
				size = 2,
				kind = "uint16",
				doc = "of the packet of channels",
			},
			{
				abbreviation = "fprime.telemetry.time_base",
				name = "time_base",
				start = 2,
				size = 2,
				kind = "uint16",
				names = {
					[0] = "none",
					[1] = "processor",
					[2] = "workstation",
					[3] = "spacecraft",
					[65535] = "any",
				},
				doc = "which clock",
			},
			{
				abbreviation = "fprime.telemetry.time_context",
				name = "time_context",
				start = 4,
				size = 1,
				kind = "uint8",
				doc = "free for the mission",
			},
			{
				abbreviation = "fprime.telemetry.seconds",
				name = "seconds",
				start = 5,
				size = 4,
				kind = "uint32",
				doc = "of that clock",
			},
			{
				abbreviation = "fprime.telemetry.microseconds",
				name = "microseconds",
				start = 9,
				size = 4,
				kind = "uint32",
				doc = "beyond its seconds",
			},
		},
		place = {packet_id = 1, time_base = 2, time_context = 3, seconds = 4, microseconds = 5},
	},
	racs2_topic = {
		name = "racs2_topic",
		protocol = "racs2",
		title = "RACS2 to ROS 2",
		size = 32,
		fields = {
			{
				abbreviation = "racs2.topic.topic_name",
				name = "topic_name",
				start = 0,
				size = 32,
				kind = "string",
				doc = "the topic that the body is published on",
			},
		},
		place = {topic_name = 1},
	},
	racs2_message = {
		name = "racs2_message",
		protocol = "racs2",
		title = "RACS2 to cFS",
		size = 32,
		fields = {
			{
				abbreviation = "racs2.message.msg_id",
				name = "msg_id",
				start = 0,
				size = 2,
				kind = "uint16",
				hex = true,
				doc = "the MsgId that the body is sent with on the software bus",
			},
			{
				abbreviation = "racs2.message.rest",
				name = "rest",
				start = 2,
				size = 30,
				kind = "bytes",
				doc = "not used, zeros",
			},
		},
		place = {msg_id = 1},
	},
	ccsds = {
		name = "ccsds",
		protocol = "ccsds_sp",
		title = "CCSDS Space Packet",
		size = 6,
		fields = {
			{
				abbreviation = "ccsds_sp.packet_version_number",
				name = "packet_version_number",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 57344,
				doc = "always 0 on this link (133.0-B 4.1.3.2)",
			},
			{
				abbreviation = "ccsds_sp.packet_type",
				name = "packet_type",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 4096,
				names = {[0] = "telemetry", [1] = "telecommand"},
				doc = "decides which cFE header follows (133.0-B 4.1.3.3.2)",
			},
			{
				abbreviation = "ccsds_sp.secondary_header_flag",
				name = "secondary_header_flag",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 2048,
				doc = "set in every cFE packet (133.0-B 4.1.3.3.3)",
			},
			{
				abbreviation = "ccsds_sp.apid",
				name = "apid",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 2047,
				hex = true,
				doc = "application process identifier (133.0-B 4.1.3.3.4)",
			},
			{
				abbreviation = "ccsds_sp.sequence_flags",
				name = "sequence_flags",
				start = 2,
				size = 2,
				kind = "uint16",
				mask = 49152,
				names = {[0] = "continuation", [1] = "first", [2] = "last", [3] = "unsegmented"},
				doc = "cFE sends 3, the EDORAS bridges 0 (133.0-B 4.1.3.4.2)",
			},
			{
				abbreviation = "ccsds_sp.packet_sequence_count",
				name = "packet_sequence_count",
				start = 2,
				size = 2,
				kind = "uint16",
				mask = 16383,
				doc = "counts the packets of one APID (133.0-B 4.1.3.4.3)",
			},
			{
				abbreviation = "ccsds_sp.packet_data_length",
				name = "packet_data_length",
				start = 4,
				size = 2,
				kind = "uint16",
				doc = "bytes of the whole packet, less 7 (133.0-B 4.1.3.5)",
			},
		},
		place = {
			packet_version_number = 1,
			packet_type = 2,
			secondary_header_flag = 3,
			apid = 4,
			sequence_flags = 5,
			packet_sequence_count = 6,
			packet_data_length = 7,
		},
	},
	extended = {
		name = "cfe_extended",
		protocol = "cfe",
		title = "cFE Extended Header",
		size = 4,
		fields = {
			{
				abbreviation = "cfe.extended.eds_version",
				name = "eds_version",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 63488,
				doc = "electronic data sheet version",
			},
			{
				abbreviation = "cfe.extended.endian",
				name = "endian",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 1024,
				names = {[0] = "big", [1] = "little"},
				doc = "payload byte order",
			},
			{
				abbreviation = "cfe.extended.playback",
				name = "playback",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 512,
				names = {[0] = "original", [1] = "playback"},
				doc = "a recorded packet sent again",
			},
			{
				abbreviation = "cfe.extended.subsystem_id",
				name = "subsystem_id",
				start = 0,
				size = 2,
				kind = "uint16",
				mask = 511,
				hex = true,
				doc = "APID qualifier: subsystem",
			},
			{
				abbreviation = "cfe.extended.system_id",
				name = "system_id",
				start = 2,
				size = 2,
				kind = "uint16",
				hex = true,
				doc = "APID qualifier: system or spacecraft",
			},
		},
		place = {eds_version = 1, endian = 2, playback = 3, subsystem_id = 4, system_id = 5},
	},
	command = {
		name = "cfe_command",
		protocol = "cfe",
		title = "cFE Command Header",
		size = 2,
		fields = {
			{
				abbreviation = "cfe.command.reserved",
				name = "reserved",
				start = 0,
				size = 1,
				kind = "uint8",
				mask = 128,
				doc = "always 0",
			},
			{
				abbreviation = "cfe.command.function_code",
				name = "function_code",
				start = 0,
				size = 1,
				kind = "uint8",
				mask = 127,
				doc = "EDORAS apps: 0 no-op, 1 set",
			},
			{
				abbreviation = "cfe.command.checksum",
				name = "checksum",
				start = 1,
				size = 1,
				kind = "uint8",
				hex = true,
				doc = "0xFF XOR every byte of the packet; the bridges send 0, no app here checks it",
			},
		},
		place = {reserved = 1, function_code = 2, checksum = 3},
	},
	command_extended = {
		name = "cfe_command",
		protocol = "cfe",
		title = "cFE Command Header (behind an extended header)",
		size = 6,
		fields = {
			{
				abbreviation = "cfe.command.reserved",
				name = "reserved",
				start = 0,
				size = 1,
				kind = "uint8",
				mask = 128,
				doc = "always 0",
			},
			{
				abbreviation = "cfe.command.function_code",
				name = "function_code",
				start = 0,
				size = 1,
				kind = "uint8",
				mask = 127,
				doc = "EDORAS apps: 0 no-op, 1 set",
			},
			{
				abbreviation = "cfe.command.checksum",
				name = "checksum",
				start = 1,
				size = 1,
				kind = "uint8",
				hex = true,
				doc = "0xFF XOR every byte of the packet; the bridges send 0, no app here checks it",
			},
			{
				abbreviation = "cfe.command.spare",
				name = "spare",
				start = 2,
				size = 4,
				kind = "bytes",
				doc = "alignment",
			},
		},
		place = {reserved = 1, function_code = 2, checksum = 3},
	},
	telemetry = {
		name = "cfe_telemetry",
		protocol = "cfe",
		title = "cFE Telemetry Header",
		size = 10,
		fields = {
			{
				abbreviation = "cfe.telemetry.seconds",
				name = "seconds",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "mission time: whole seconds since the mission's epoch, not UTC",
			},
			{
				abbreviation = "cfe.telemetry.subseconds",
				name = "subseconds",
				start = 4,
				size = 2,
				kind = "uint16",
				doc = "mission time: 1/65536 s",
			},
			{
				abbreviation = "cfe.telemetry.spare",
				name = "spare",
				start = 6,
				size = 4,
				kind = "bytes",
				doc = "alignment",
			},
		},
		place = {seconds = 1, subseconds = 2},
	},
	telemetry_short = {
		name = "cfe_telemetry",
		protocol = "cfe",
		title = "cFE Telemetry Header (12 bytes, older builds)",
		size = 6,
		fields = {
			{
				abbreviation = "cfe.telemetry.seconds",
				name = "seconds",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "mission time: whole seconds since the mission's epoch, not UTC",
			},
			{
				abbreviation = "cfe.telemetry.subseconds",
				name = "subseconds",
				start = 4,
				size = 2,
				kind = "uint16",
				doc = "mission time: 1/65536 s",
			},
		},
		place = {seconds = 1, subseconds = 2},
	},
	telemetry_extended = {
		name = "cfe_telemetry",
		protocol = "cfe",
		title = "cFE Telemetry Header (behind an extended header)",
		size = 6,
		fields = {
			{
				abbreviation = "cfe.telemetry.seconds",
				name = "seconds",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "mission time: whole seconds since the mission's epoch, not UTC",
			},
			{
				abbreviation = "cfe.telemetry.subseconds",
				name = "subseconds",
				start = 4,
				size = 2,
				kind = "uint16",
				doc = "mission time: 1/65536 s",
			},
		},
		place = {seconds = 1, subseconds = 2},
	},
	event = {
		name = "cfe_event",
		protocol = "cfe",
		title = "cFE Event (EVS long format)",
		size = 156,
		little = true,
		fields = {
			{
				abbreviation = "cfe.event.app_name",
				name = "app_name",
				start = 0,
				size = 20,
				kind = "string",
				doc = "who reports",
			},
			{
				abbreviation = "cfe.event.event_id",
				name = "event_id",
				start = 20,
				size = 2,
				kind = "uint16",
				doc = "the app's number for it",
			},
			{
				abbreviation = "cfe.event.event_type",
				name = "event_type",
				start = 22,
				size = 2,
				kind = "uint16",
				names = {[1] = "debug", [2] = "info", [3] = "error", [4] = "critical"},
				doc = "severity",
			},
			{
				abbreviation = "cfe.event.spacecraft_id",
				name = "spacecraft_id",
				start = 24,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "where",
			},
			{
				abbreviation = "cfe.event.processor_id",
				name = "processor_id",
				start = 28,
				size = 4,
				kind = "uint32",
				doc = "on which processor",
			},
			{
				abbreviation = "cfe.event.message",
				name = "message",
				start = 32,
				size = 122,
				kind = "string",
				doc = "what happened",
			},
			{
				abbreviation = "cfe.event.spare",
				name = "spare",
				start = 154,
				size = 2,
				kind = "bytes",
				doc = "alignment",
			},
		},
		place = {
			event_id = 1,
			event_type = 2,
			spacecraft_id = 3,
			processor_id = 4,
			app_name = 5,
			message = 6,
		},
	},
	software_bus = {
		name = "cfe_software_bus",
		protocol = "cfe",
		title = "cFE Software Bus Housekeeping",
		size = 28,
		little = true,
		fields = {
			{
				abbreviation = "cfe.software_bus.command_counter",
				name = "command_counter",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "ground commands accepted",
			},
			{
				abbreviation = "cfe.software_bus.command_error_counter",
				name = "command_error_counter",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "ground commands refused",
			},
			{
				abbreviation = "cfe.software_bus.no_subscribers_counter",
				name = "no_subscribers_counter",
				start = 2,
				size = 1,
				kind = "uint8",
				doc = "messages sent that nobody takes",
			},
			{
				abbreviation = "cfe.software_bus.message_send_error_counter",
				name = "message_send_error_counter",
				start = 3,
				size = 1,
				kind = "uint8",
				doc = "sends that failed",
			},
			{
				abbreviation = "cfe.software_bus.message_receive_error_counter",
				name = "message_receive_error_counter",
				start = 4,
				size = 1,
				kind = "uint8",
				doc = "receives that failed",
			},
			{
				abbreviation = "cfe.software_bus.internal_error_counter",
				name = "internal_error_counter",
				start = 5,
				size = 1,
				kind = "uint8",
				doc = "queue reads and writes that failed",
			},
			{
				abbreviation = "cfe.software_bus.create_pipe_error_counter",
				name = "create_pipe_error_counter",
				start = 6,
				size = 1,
				kind = "uint8",
				doc = "pipes that could not be made",
			},
			{
				abbreviation = "cfe.software_bus.subscribe_error_counter",
				name = "subscribe_error_counter",
				start = 7,
				size = 1,
				kind = "uint8",
				doc = "subscriptions that failed",
			},
			{
				abbreviation = "cfe.software_bus.pipe_options_error_counter",
				name = "pipe_options_error_counter",
				start = 8,
				size = 1,
				kind = "uint8",
				doc = "pipe options that failed",
			},
			{
				abbreviation = "cfe.software_bus.duplicate_subscriptions_counter",
				name = "duplicate_subscriptions_counter",
				start = 9,
				size = 1,
				kind = "uint8",
				doc = "subscriptions made twice",
			},
			{
				abbreviation = "cfe.software_bus.get_pipe_id_by_name_error_counter",
				name = "get_pipe_id_by_name_error_counter",
				start = 10,
				size = 1,
				kind = "uint8",
				doc = "pipe names not found",
			},
			{
				abbreviation = "cfe.software_bus.spare",
				name = "spare",
				start = 11,
				size = 1,
				kind = "uint8",
				doc = "alignment",
			},
			{
				abbreviation = "cfe.software_bus.pipe_overflow_error_counter",
				name = "pipe_overflow_error_counter",
				start = 12,
				size = 2,
				kind = "uint16",
				doc = "messages lost because a pipe was full",
			},
			{
				abbreviation = "cfe.software_bus.message_limit_error_counter",
				name = "message_limit_error_counter",
				start = 14,
				size = 2,
				kind = "uint16",
				doc = "messages lost because too many of one MsgId waited in a pipe",
			},
			{
				abbreviation = "cfe.software_bus.memory_pool_handle",
				name = "memory_pool_handle",
				start = 16,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "the pool's handle",
			},
			{
				abbreviation = "cfe.software_bus.memory_in_use",
				name = "memory_in_use",
				start = 20,
				size = 4,
				kind = "uint32",
				doc = "bytes of the pool in use",
			},
			{
				abbreviation = "cfe.software_bus.unmarked_memory",
				name = "unmarked_memory",
				start = 24,
				size = 4,
				kind = "uint32",
				doc = "bytes of the pool never used",
			},
		},
		place = {
			command_counter = 1,
			command_error_counter = 2,
			no_subscribers_counter = 3,
			message_send_error_counter = 4,
			message_receive_error_counter = 5,
			internal_error_counter = 6,
			create_pipe_error_counter = 7,
			subscribe_error_counter = 8,
			pipe_options_error_counter = 9,
			duplicate_subscriptions_counter = 10,
			get_pipe_id_by_name_error_counter = 11,
			spare = 12,
			pipe_overflow_error_counter = 13,
			message_limit_error_counter = 14,
			memory_pool_handle = 15,
			memory_in_use = 16,
			unmarked_memory = 17,
		},
	},
	sbn_legacy = {
		name = "sbn",
		protocol = "sbn",
		title = "Software Bus Network (7-byte header, older sources)",
		size = 7,
		fields = {
			{
				abbreviation = "sbn.msg_size",
				name = "msg_size",
				start = 0,
				size = 2,
				kind = "int16",
				doc = "payload bytes; this header is not counted",
			},
			{
				abbreviation = "sbn.msg_type",
				name = "msg_type",
				start = 2,
				size = 1,
				kind = "uint8",
				hex = true,
				names = {
					[0] = "NO_MSG",
					[1] = "SUB",
					[2] = "UNSUB",
					[3] = "APP",
					[4] = "PROTO",
					[160] = "HEARTBEAT",
					[161] = "ANNOUNCE",
					[162] = "DISCONNECT",
				},
				doc = "what the payload is",
			},
			{
				abbreviation = "sbn.processor_id",
				name = "processor_id",
				start = 3,
				size = 4,
				kind = "uint32",
				doc = "the sender's processor",
			},
		},
		place = {msg_size = 1, msg_type = 2, processor_id = 3},
	},
	subscription = {
		name = "sbn_subscription",
		protocol = "sbn",
		title = "Subscription",
		size = 6,
		fields = {
			{
				abbreviation = "sbn.subscription.msg_id",
				name = "msg_id",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "the MsgId wanted",
			},
			{
				abbreviation = "sbn.subscription.priority",
				name = "priority",
				start = 4,
				size = 1,
				kind = "uint8",
				doc = "quality of service: priority",
			},
			{
				abbreviation = "sbn.subscription.reliability",
				name = "reliability",
				start = 5,
				size = 1,
				kind = "uint8",
				doc = "quality of service: reliability",
			},
		},
		place = {msg_id = 1, priority = 2, reliability = 3},
	},
	cdr = {
		name = "cdr",
		protocol = "ros2cdr",
		title = "CDR",
		size = 4,
		fields = {
			{
				abbreviation = "ros2cdr.representation",
				name = "representation",
				start = 0,
				size = 2,
				kind = "uint16",
				hex = true,
				names = {
					[0] = "CDR big-endian",
					[1] = "CDR little-endian",
					[2] = "PL_CDR big-endian",
					[3] = "PL_CDR little-endian",
				},
				doc = "how the body is encoded; alignment counts from the byte after this header (RTPS 10.5)",
			},
			{
				abbreviation = "ros2cdr.options",
				name = "options",
				start = 2,
				size = 2,
				kind = "uint16",
				hex = true,
				doc = "unused, 0",
			},
		},
		place = {representation = 1, options = 2},
	},
	es_restart = {
		name = "es_restart",
		protocol = "cfe",
		title = "RESTART",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.restart_type",
				name = "restart_type",
				start = 0,
				size = 2,
				kind = "uint16",
				names = {[1] = "processor", [2] = "power_on"},
				doc = "how",
			},
		},
		most = 2,
	},
	es_start_app = {
		name = "es_start_app",
		protocol = "cfe",
		title = "START_APP",
		size = 112,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
			{
				abbreviation = "cfe.es.entry_point",
				name = "entry_point",
				start = 20,
				size = 20,
				kind = "string",
				doc = "its main function",
			},
			{
				abbreviation = "cfe.es.file_name",
				name = "file_name",
				start = 40,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
			{
				abbreviation = "cfe.es.stack_size",
				name = "stack_size",
				start = 104,
				size = 4,
				kind = "uint32",
				doc = "bytes",
			},
			{
				abbreviation = "cfe.es.exception_action",
				name = "exception_action",
				start = 108,
				size = 1,
				kind = "uint8",
				names = {[0] = "restart_app", [1] = "restart_all"},
				doc = "on an exception",
				silent = true,
			},
			{
				abbreviation = "cfe.es.priority",
				name = "priority",
				start = 110,
				size = 2,
				kind = "uint16",
				doc = "of its task; 0 is highest",
			},
		},
		most = 116,
	},
	es_stop_app = {
		name = "es_stop_app",
		protocol = "cfe",
		title = "STOP_APP",
		size = 20,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
		},
		most = 20,
	},
	es_restart_app = {
		name = "es_restart_app",
		protocol = "cfe",
		title = "RESTART_APP",
		size = 20,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
		},
		most = 20,
	},
	es_reload_app = {
		name = "es_reload_app",
		protocol = "cfe",
		title = "RELOAD_APP",
		size = 84,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
			{
				abbreviation = "cfe.es.file_name",
				name = "file_name",
				start = 20,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 84,
	},
	es_query_one = {
		name = "es_query_one",
		protocol = "cfe",
		title = "QUERY_ONE",
		size = 20,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
		},
		most = 20,
	},
	es_query_all = {
		name = "es_query_all",
		protocol = "cfe",
		title = "QUERY_ALL",
		size = 64,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.file_name",
				name = "file_name",
				start = 0,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 64,
	},
	es_write_sys_log = {
		name = "es_write_sys_log",
		protocol = "cfe",
		title = "WRITE_SYS_LOG",
		size = 64,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.file_name",
				name = "file_name",
				start = 0,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 64,
	},
	es_write_er_log = {
		name = "es_write_er_log",
		protocol = "cfe",
		title = "WRITE_ER_LOG",
		size = 64,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.file_name",
				name = "file_name",
				start = 0,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 64,
	},
	es_start_perf_data = {
		name = "es_start_perf_data",
		protocol = "cfe",
		title = "START_PERF_DATA",
		size = 4,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.trigger_mode",
				name = "trigger_mode",
				start = 0,
				size = 4,
				kind = "uint32",
				names = {[0] = "start", [1] = "center", [2] = "end"},
				doc = "where the trigger lies",
			},
		},
		most = 4,
	},
	es_stop_perf_data = {
		name = "es_stop_perf_data",
		protocol = "cfe",
		title = "STOP_PERF_DATA",
		size = 64,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.file_name",
				name = "file_name",
				start = 0,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 64,
	},
	es_set_perf_filter_mask = {
		name = "es_set_perf_filter_mask",
		protocol = "cfe",
		title = "SET_PERF_FILTER_MASK",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.mask_number",
				name = "mask_number",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "which 32 markers, from 0",
			},
			{
				abbreviation = "cfe.es.mask",
				name = "mask",
				start = 4,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "a bit a marker",
			},
		},
		most = 8,
	},
	es_set_perf_trigger_mask = {
		name = "es_set_perf_trigger_mask",
		protocol = "cfe",
		title = "SET_PERF_TRIGGER_MASK",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.mask_number",
				name = "mask_number",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "which 32 markers, from 0",
			},
			{
				abbreviation = "cfe.es.mask",
				name = "mask",
				start = 4,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "a bit a marker",
			},
		},
		most = 8,
	},
	es_over_write_sys_log = {
		name = "es_over_write_sys_log",
		protocol = "cfe",
		title = "OVER_WRITE_SYS_LOG",
		size = 4,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.mode",
				name = "mode",
				start = 0,
				size = 4,
				kind = "uint32",
				names = {[0] = "overwrite", [1] = "discard"},
				doc = "what a full log does",
			},
		},
		most = 4,
	},
	es_set_max_pr_count = {
		name = "es_set_max_pr_count",
		protocol = "cfe",
		title = "SET_MAX_PR_COUNT",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.max_resets",
				name = "max_resets",
				start = 0,
				size = 2,
				kind = "uint16",
				doc = "processor resets before a power-on reset",
			},
		},
		most = 2,
	},
	es_delete_cds = {
		name = "es_delete_cds",
		protocol = "cfe",
		title = "DELETE_CDS",
		size = 40,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.cds_name",
				name = "cds_name",
				start = 0,
				size = 40,
				kind = "string",
				doc = "APPLICATION.STORE",
			},
		},
		most = 40,
	},
	es_send_mem_pool_stats = {
		name = "es_send_mem_pool_stats",
		protocol = "cfe",
		title = "SEND_MEM_POOL_STATS",
		size = 24,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
			{
				abbreviation = "cfe.es.pool_handle",
				name = "pool_handle",
				start = 20,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "of the memory pool",
			},
		},
		most = 24,
	},
	es_dump_cds_registry = {
		name = "es_dump_cds_registry",
		protocol = "cfe",
		title = "DUMP_CDS_REGISTRY",
		size = 64,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.file_name",
				name = "file_name",
				start = 0,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 64,
	},
	es_query_all_tasks = {
		name = "es_query_all_tasks",
		protocol = "cfe",
		title = "QUERY_ALL_TASKS",
		size = 64,
		little = true,
		fields = {
			{
				abbreviation = "cfe.es.file_name",
				name = "file_name",
				start = 0,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 64,
	},
	evs_enable_event_type = {
		name = "evs_enable_event_type",
		protocol = "cfe",
		title = "ENABLE_EVENT_TYPE",
		size = 1,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.event_types",
				name = "event_types",
				start = 0,
				size = 1,
				kind = "uint8",
				hex = true,
				doc = "a bit each: 1 debug, 2 info, 4 error, 8 critical",
			},
		},
		most = 2,
	},
	evs_disable_event_type = {
		name = "evs_disable_event_type",
		protocol = "cfe",
		title = "DISABLE_EVENT_TYPE",
		size = 1,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.event_types",
				name = "event_types",
				start = 0,
				size = 1,
				kind = "uint8",
				hex = true,
				doc = "a bit each: 1 debug, 2 info, 4 error, 8 critical",
			},
		},
		most = 2,
	},
	evs_set_event_format_mode = {
		name = "evs_set_event_format_mode",
		protocol = "cfe",
		title = "SET_EVENT_FORMAT_MODE",
		size = 1,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.format",
				name = "format",
				start = 0,
				size = 1,
				kind = "uint8",
				names = {[0] = "short", [1] = "long"},
				doc = "of events",
			},
		},
		most = 2,
	},
	evs_enable_app_event_type = {
		name = "evs_enable_app_event_type",
		protocol = "cfe",
		title = "ENABLE_APP_EVENT_TYPE",
		size = 21,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
			{
				abbreviation = "cfe.evs.event_types",
				name = "event_types",
				start = 20,
				size = 1,
				kind = "uint8",
				hex = true,
				doc = "a bit each: 1 debug, 2 info, 4 error, 8 critical",
			},
		},
		most = 22,
	},
	evs_disable_app_event_type = {
		name = "evs_disable_app_event_type",
		protocol = "cfe",
		title = "DISABLE_APP_EVENT_TYPE",
		size = 21,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
			{
				abbreviation = "cfe.evs.event_types",
				name = "event_types",
				start = 20,
				size = 1,
				kind = "uint8",
				hex = true,
				doc = "a bit each: 1 debug, 2 info, 4 error, 8 critical",
			},
		},
		most = 22,
	},
	evs_enable_app_events = {
		name = "evs_enable_app_events",
		protocol = "cfe",
		title = "ENABLE_APP_EVENTS",
		size = 20,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
		},
		most = 20,
	},
	evs_disable_app_events = {
		name = "evs_disable_app_events",
		protocol = "cfe",
		title = "DISABLE_APP_EVENTS",
		size = 20,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
		},
		most = 20,
	},
	evs_reset_app_counter = {
		name = "evs_reset_app_counter",
		protocol = "cfe",
		title = "RESET_APP_COUNTER",
		size = 20,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
		},
		most = 20,
	},
	evs_set_filter = {
		name = "evs_set_filter",
		protocol = "cfe",
		title = "SET_FILTER",
		size = 24,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
			{
				abbreviation = "cfe.evs.event_id",
				name = "event_id",
				start = 20,
				size = 2,
				kind = "uint16",
				doc = "the application's number for it",
			},
			{
				abbreviation = "cfe.evs.mask",
				name = "mask",
				start = 22,
				size = 2,
				kind = "uint16",
				hex = true,
				doc = "an event passes where its count and this are 0",
			},
		},
		most = 24,
	},
	evs_enable_ports = {
		name = "evs_enable_ports",
		protocol = "cfe",
		title = "ENABLE_PORTS",
		size = 1,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.ports",
				name = "ports",
				start = 0,
				size = 1,
				kind = "uint8",
				hex = true,
				doc = "a bit each: 1, 2, 4, 8 for ports 1 to 4",
			},
		},
		most = 2,
	},
	evs_disable_ports = {
		name = "evs_disable_ports",
		protocol = "cfe",
		title = "DISABLE_PORTS",
		size = 1,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.ports",
				name = "ports",
				start = 0,
				size = 1,
				kind = "uint8",
				hex = true,
				doc = "a bit each: 1, 2, 4, 8 for ports 1 to 4",
			},
		},
		most = 2,
	},
	evs_reset_filter = {
		name = "evs_reset_filter",
		protocol = "cfe",
		title = "RESET_FILTER",
		size = 22,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
			{
				abbreviation = "cfe.evs.event_id",
				name = "event_id",
				start = 20,
				size = 2,
				kind = "uint16",
				doc = "the application's number for it",
			},
		},
		most = 22,
	},
	evs_reset_all_filters = {
		name = "evs_reset_all_filters",
		protocol = "cfe",
		title = "RESET_ALL_FILTERS",
		size = 20,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
		},
		most = 20,
	},
	evs_add_event_filter = {
		name = "evs_add_event_filter",
		protocol = "cfe",
		title = "ADD_EVENT_FILTER",
		size = 24,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
			{
				abbreviation = "cfe.evs.event_id",
				name = "event_id",
				start = 20,
				size = 2,
				kind = "uint16",
				doc = "the application's number for it",
			},
			{
				abbreviation = "cfe.evs.mask",
				name = "mask",
				start = 22,
				size = 2,
				kind = "uint16",
				hex = true,
				doc = "an event passes where its count and this are 0",
			},
		},
		most = 24,
	},
	evs_delete_event_filter = {
		name = "evs_delete_event_filter",
		protocol = "cfe",
		title = "DELETE_EVENT_FILTER",
		size = 22,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.application",
				name = "application",
				start = 0,
				size = 20,
				kind = "string",
				doc = "as events print it",
			},
			{
				abbreviation = "cfe.evs.event_id",
				name = "event_id",
				start = 20,
				size = 2,
				kind = "uint16",
				doc = "the application's number for it",
			},
		},
		most = 22,
	},
	evs_write_app_data_file = {
		name = "evs_write_app_data_file",
		protocol = "cfe",
		title = "WRITE_APP_DATA_FILE",
		size = 64,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.file_name",
				name = "file_name",
				start = 0,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 64,
	},
	evs_write_log_data_file = {
		name = "evs_write_log_data_file",
		protocol = "cfe",
		title = "WRITE_LOG_DATA_FILE",
		size = 64,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.file_name",
				name = "file_name",
				start = 0,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 64,
	},
	evs_set_log_mode = {
		name = "evs_set_log_mode",
		protocol = "cfe",
		title = "SET_LOG_MODE",
		size = 1,
		little = true,
		fields = {
			{
				abbreviation = "cfe.evs.mode",
				name = "mode",
				start = 0,
				size = 1,
				kind = "uint8",
				names = {[0] = "overwrite", [1] = "discard"},
				doc = "what a full log does",
			},
		},
		most = 2,
	},
	sb_write_routing_info = {
		name = "sb_write_routing_info",
		protocol = "cfe",
		title = "WRITE_ROUTING_INFO",
		size = 64,
		little = true,
		fields = {
			{
				abbreviation = "cfe.sb.file_name",
				name = "file_name",
				start = 0,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 64,
	},
	sb_enable_route = {
		name = "sb_enable_route",
		protocol = "cfe",
		title = "ENABLE_ROUTE",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.sb.msg_id",
				name = "msg_id",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "MsgId",
			},
			{
				abbreviation = "cfe.sb.pipe_id",
				name = "pipe_id",
				start = 4,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "as the routing file has it",
			},
		},
		most = 12,
	},
	sb_disable_route = {
		name = "sb_disable_route",
		protocol = "cfe",
		title = "DISABLE_ROUTE",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.sb.msg_id",
				name = "msg_id",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "MsgId",
			},
			{
				abbreviation = "cfe.sb.pipe_id",
				name = "pipe_id",
				start = 4,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "as the routing file has it",
			},
		},
		most = 12,
	},
	sb_write_pipe_info = {
		name = "sb_write_pipe_info",
		protocol = "cfe",
		title = "WRITE_PIPE_INFO",
		size = 64,
		little = true,
		fields = {
			{
				abbreviation = "cfe.sb.file_name",
				name = "file_name",
				start = 0,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 64,
	},
	sb_write_map_info = {
		name = "sb_write_map_info",
		protocol = "cfe",
		title = "WRITE_MAP_INFO",
		size = 64,
		little = true,
		fields = {
			{
				abbreviation = "cfe.sb.file_name",
				name = "file_name",
				start = 0,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 64,
	},
	tbl_load = {
		name = "tbl_load",
		protocol = "cfe",
		title = "LOAD",
		size = 64,
		little = true,
		fields = {
			{
				abbreviation = "cfe.tbl.file_name",
				name = "file_name",
				start = 0,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 64,
	},
	tbl_dump = {
		name = "tbl_dump",
		protocol = "cfe",
		title = "DUMP",
		size = 106,
		little = true,
		fields = {
			{
				abbreviation = "cfe.tbl.buffer",
				name = "buffer",
				start = 0,
				size = 2,
				kind = "uint16",
				names = {[0] = "inactive", [1] = "active"},
				doc = "which image",
			},
			{
				abbreviation = "cfe.tbl.table_name",
				name = "table_name",
				start = 2,
				size = 40,
				kind = "string",
				doc = "APPLICATION.TABLE",
			},
			{
				abbreviation = "cfe.tbl.file_name",
				name = "file_name",
				start = 42,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 106,
	},
	tbl_validate = {
		name = "tbl_validate",
		protocol = "cfe",
		title = "VALIDATE",
		size = 42,
		little = true,
		fields = {
			{
				abbreviation = "cfe.tbl.buffer",
				name = "buffer",
				start = 0,
				size = 2,
				kind = "uint16",
				names = {[0] = "inactive", [1] = "active"},
				doc = "which image",
			},
			{
				abbreviation = "cfe.tbl.table_name",
				name = "table_name",
				start = 2,
				size = 40,
				kind = "string",
				doc = "APPLICATION.TABLE",
			},
		},
		most = 42,
	},
	tbl_activate = {
		name = "tbl_activate",
		protocol = "cfe",
		title = "ACTIVATE",
		size = 40,
		little = true,
		fields = {
			{
				abbreviation = "cfe.tbl.table_name",
				name = "table_name",
				start = 0,
				size = 40,
				kind = "string",
				doc = "APPLICATION.TABLE",
			},
		},
		most = 40,
	},
	tbl_dump_registry = {
		name = "tbl_dump_registry",
		protocol = "cfe",
		title = "DUMP_REGISTRY",
		size = 64,
		little = true,
		fields = {
			{
				abbreviation = "cfe.tbl.file_name",
				name = "file_name",
				start = 0,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 64,
	},
	tbl_send_registry = {
		name = "tbl_send_registry",
		protocol = "cfe",
		title = "SEND_REGISTRY",
		size = 40,
		little = true,
		fields = {
			{
				abbreviation = "cfe.tbl.table_name",
				name = "table_name",
				start = 0,
				size = 40,
				kind = "string",
				doc = "APPLICATION.TABLE",
			},
		},
		most = 40,
	},
	tbl_delete_cds = {
		name = "tbl_delete_cds",
		protocol = "cfe",
		title = "DELETE_CDS",
		size = 40,
		little = true,
		fields = {
			{
				abbreviation = "cfe.tbl.table_name",
				name = "table_name",
				start = 0,
				size = 40,
				kind = "string",
				doc = "APPLICATION.TABLE",
			},
		},
		most = 40,
	},
	tbl_abort_load = {
		name = "tbl_abort_load",
		protocol = "cfe",
		title = "ABORT_LOAD",
		size = 40,
		little = true,
		fields = {
			{
				abbreviation = "cfe.tbl.table_name",
				name = "table_name",
				start = 0,
				size = 40,
				kind = "string",
				doc = "APPLICATION.TABLE",
			},
		},
		most = 40,
	},
	time_set_source = {
		name = "time_set_source",
		protocol = "cfe",
		title = "SET_SOURCE",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.time.source",
				name = "source",
				start = 0,
				size = 2,
				kind = "uint16",
				names = {[1] = "internal", [2] = "external"},
				doc = "of time",
			},
		},
		most = 2,
	},
	time_set_state = {
		name = "time_set_state",
		protocol = "cfe",
		title = "SET_STATE",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.time.state",
				name = "state",
				start = 0,
				size = 2,
				kind = "int16",
				names = {[-1] = "invalid", [0] = "valid", [1] = "flywheel"},
				doc = "of the clock",
			},
		},
		most = 2,
	},
	time_add_delay = {
		name = "time_add_delay",
		protocol = "cfe",
		title = "ADD_DELAY",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.time.seconds",
				name = "seconds",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "whole seconds",
			},
			{
				abbreviation = "cfe.time.microseconds",
				name = "microseconds",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "0 to 999,999",
			},
		},
		most = 8,
	},
	time_sub_delay = {
		name = "time_sub_delay",
		protocol = "cfe",
		title = "SUB_DELAY",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.time.seconds",
				name = "seconds",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "whole seconds",
			},
			{
				abbreviation = "cfe.time.microseconds",
				name = "microseconds",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "0 to 999,999",
			},
		},
		most = 8,
	},
	time_set_time = {
		name = "time_set_time",
		protocol = "cfe",
		title = "SET_TIME",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.time.seconds",
				name = "seconds",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "whole seconds",
			},
			{
				abbreviation = "cfe.time.microseconds",
				name = "microseconds",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "0 to 999,999",
			},
		},
		most = 8,
	},
	time_set_met = {
		name = "time_set_met",
		protocol = "cfe",
		title = "SET_MET",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.time.seconds",
				name = "seconds",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "whole seconds",
			},
			{
				abbreviation = "cfe.time.microseconds",
				name = "microseconds",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "0 to 999,999",
			},
		},
		most = 8,
	},
	time_set_stcf = {
		name = "time_set_stcf",
		protocol = "cfe",
		title = "SET_STCF",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.time.seconds",
				name = "seconds",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "whole seconds",
			},
			{
				abbreviation = "cfe.time.microseconds",
				name = "microseconds",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "0 to 999,999",
			},
		},
		most = 8,
	},
	time_set_leap_seconds = {
		name = "time_set_leap_seconds",
		protocol = "cfe",
		title = "SET_LEAP_SECONDS",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.time.leap_seconds",
				name = "leap_seconds",
				start = 0,
				size = 2,
				kind = "int16",
				doc = "TAI - UTC, s",
			},
		},
		most = 2,
	},
	time_add_adjust = {
		name = "time_add_adjust",
		protocol = "cfe",
		title = "ADD_ADJUST",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.time.seconds",
				name = "seconds",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "whole seconds",
			},
			{
				abbreviation = "cfe.time.microseconds",
				name = "microseconds",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "0 to 999,999",
			},
		},
		most = 8,
	},
	time_sub_adjust = {
		name = "time_sub_adjust",
		protocol = "cfe",
		title = "SUB_ADJUST",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.time.seconds",
				name = "seconds",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "whole seconds",
			},
			{
				abbreviation = "cfe.time.microseconds",
				name = "microseconds",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "0 to 999,999",
			},
		},
		most = 8,
	},
	time_add_one_hz = {
		name = "time_add_one_hz",
		protocol = "cfe",
		title = "ADD_ONE_HZ",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.time.seconds",
				name = "seconds",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "whole seconds",
			},
			{
				abbreviation = "cfe.time.subseconds",
				name = "subseconds",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
		},
		most = 8,
	},
	time_sub_one_hz = {
		name = "time_sub_one_hz",
		protocol = "cfe",
		title = "SUB_ONE_HZ",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.time.seconds",
				name = "seconds",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "whole seconds",
			},
			{
				abbreviation = "cfe.time.subseconds",
				name = "subseconds",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
		},
		most = 8,
	},
	time_set_signal = {
		name = "time_set_signal",
		protocol = "cfe",
		title = "SET_SIGNAL",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.time.signal",
				name = "signal",
				start = 0,
				size = 2,
				kind = "uint16",
				names = {[1] = "primary", [2] = "redundant"},
				doc = "tone",
			},
		},
		most = 2,
	},
	to_add_pkt = {
		name = "to_add_pkt",
		protocol = "cfe",
		title = "ADD_PKT",
		size = 7,
		little = true,
		fields = {
			{
				abbreviation = "cfe.to.stream",
				name = "stream",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "MsgId; its second half is a packet size in old builds",
			},
			{
				abbreviation = "cfe.to.priority",
				name = "priority",
				start = 4,
				size = 1,
				kind = "uint8",
				names = {[0] = "low", [1] = "high"},
				doc = "quality of service",
				silent = true,
			},
			{
				abbreviation = "cfe.to.reliability",
				name = "reliability",
				start = 5,
				size = 1,
				kind = "uint8",
				names = {[0] = "low", [1] = "high"},
				doc = "quality of service",
				silent = true,
			},
			{
				abbreviation = "cfe.to.limit",
				name = "limit",
				start = 6,
				size = 1,
				kind = "uint8",
				doc = "messages of it that may wait",
			},
		},
		most = 8,
	},
	to_remove_pkt = {
		name = "to_remove_pkt",
		protocol = "cfe",
		title = "REMOVE_PKT",
		size = 4,
		little = true,
		fields = {
			{
				abbreviation = "cfe.to.stream",
				name = "stream",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "MsgId; its second half is a packet size in old builds",
			},
		},
		most = 4,
	},
	to_enable_output = {
		name = "to_enable_output",
		protocol = "cfe",
		title = "ENABLE_OUTPUT",
		size = 16,
		little = true,
		fields = {
			{
				abbreviation = "cfe.to.address",
				name = "address",
				start = 0,
				size = 16,
				kind = "string",
				doc = "IPv4 address that telemetry goes to",
			},
		},
		most = 20,
	},
	sch_enable = {
		name = "sch_enable",
		protocol = "cfe",
		title = "ENABLE",
		size = 4,
		little = true,
		fields = {
			{
				abbreviation = "cfe.sch.slot",
				name = "slot",
				start = 0,
				size = 2,
				kind = "uint16",
				doc = "of the schedule",
			},
			{
				abbreviation = "cfe.sch.entry",
				name = "entry",
				start = 2,
				size = 2,
				kind = "uint16",
				doc = "of the slot",
			},
		},
		most = 4,
	},
	sch_disable = {
		name = "sch_disable",
		protocol = "cfe",
		title = "DISABLE",
		size = 4,
		little = true,
		fields = {
			{
				abbreviation = "cfe.sch.slot",
				name = "slot",
				start = 0,
				size = 2,
				kind = "uint16",
				doc = "of the schedule",
			},
			{
				abbreviation = "cfe.sch.entry",
				name = "entry",
				start = 2,
				size = 2,
				kind = "uint16",
				doc = "of the slot",
			},
		},
		most = 4,
	},
	sch_enable_group = {
		name = "sch_enable_group",
		protocol = "cfe",
		title = "ENABLE_GROUP",
		size = 4,
		little = true,
		fields = {
			{
				abbreviation = "cfe.sch.groups",
				name = "groups",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "a group in 8 bits, then 24 bits, one for each multi-group",
			},
		},
		most = 4,
	},
	sch_disable_group = {
		name = "sch_disable_group",
		protocol = "cfe",
		title = "DISABLE_GROUP",
		size = 4,
		little = true,
		fields = {
			{
				abbreviation = "cfe.sch.groups",
				name = "groups",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "a group in 8 bits, then 24 bits, one for each multi-group",
			},
		},
		most = 4,
	},
	cf_reset_counters = {
		name = "cf_reset_counters",
		protocol = "cfe",
		title = "RESET_COUNTERS",
		size = 1,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.counters",
				name = "counters",
				start = 0,
				size = 1,
				kind = "uint8",
				names = {[0] = "all", [1] = "command", [2] = "fault", [3] = "up", [4] = "down"},
				doc = "which",
				silent = true,
			},
		},
		most = 4,
	},
	cf_tx_file = {
		name = "cf_tx_file",
		protocol = "cfe",
		title = "TX_FILE",
		size = 136,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.cfdp_class",
				name = "cfdp_class",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "0 unacknowledged, 1 acknowledged",
			},
			{
				abbreviation = "cfe.cf.keep",
				name = "keep",
				start = 1,
				size = 1,
				kind = "uint8",
				names = {[0] = "delete", [1] = "keep"},
				doc = "",
			},
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 2,
				size = 1,
				kind = "uint8",
				doc = "",
				silent = true,
			},
			{
				abbreviation = "cfe.cf.priority",
				name = "priority",
				start = 3,
				size = 1,
				kind = "uint8",
				doc = "0 is highest",
				silent = true,
			},
			{
				abbreviation = "cfe.cf.destination",
				name = "destination",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "entity ID",
			},
			{
				abbreviation = "cfe.cf.source_name",
				name = "source_name",
				start = 8,
				size = 64,
				kind = "string",
				doc = "file or folder on the flight computer",
			},
			{
				abbreviation = "cfe.cf.destination_name",
				name = "destination_name",
				start = 72,
				size = 64,
				kind = "string",
				doc = "there",
			},
		},
		most = 136,
	},
	cf_playback_dir = {
		name = "cf_playback_dir",
		protocol = "cfe",
		title = "PLAYBACK_DIR",
		size = 136,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.cfdp_class",
				name = "cfdp_class",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "0 unacknowledged, 1 acknowledged",
			},
			{
				abbreviation = "cfe.cf.keep",
				name = "keep",
				start = 1,
				size = 1,
				kind = "uint8",
				names = {[0] = "delete", [1] = "keep"},
				doc = "",
			},
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 2,
				size = 1,
				kind = "uint8",
				doc = "",
				silent = true,
			},
			{
				abbreviation = "cfe.cf.priority",
				name = "priority",
				start = 3,
				size = 1,
				kind = "uint8",
				doc = "0 is highest",
				silent = true,
			},
			{
				abbreviation = "cfe.cf.destination",
				name = "destination",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "entity ID",
			},
			{
				abbreviation = "cfe.cf.source_name",
				name = "source_name",
				start = 8,
				size = 64,
				kind = "string",
				doc = "file or folder on the flight computer",
			},
			{
				abbreviation = "cfe.cf.destination_name",
				name = "destination_name",
				start = 72,
				size = 64,
				kind = "string",
				doc = "there",
			},
		},
		most = 136,
	},
	cf_freeze = {
		name = "cf_freeze",
		protocol = "cfe",
		title = "FREEZE",
		size = 1,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "255 for all",
			},
		},
		most = 4,
	},
	cf_thaw = {
		name = "cf_thaw",
		protocol = "cfe",
		title = "THAW",
		size = 1,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "255 for all",
			},
		},
		most = 4,
	},
	cf_suspend = {
		name = "cf_suspend",
		protocol = "cfe",
		title = "SUSPEND",
		size = 9,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.sequence",
				name = "sequence",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "of the transaction",
			},
			{
				abbreviation = "cfe.cf.entity_id",
				name = "entity_id",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "that began it",
			},
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 8,
				size = 1,
				kind = "uint8",
				doc = "254 for any of it, 255 for all",
			},
		},
		most = 12,
	},
	cf_resume = {
		name = "cf_resume",
		protocol = "cfe",
		title = "RESUME",
		size = 9,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.sequence",
				name = "sequence",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "of the transaction",
			},
			{
				abbreviation = "cfe.cf.entity_id",
				name = "entity_id",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "that began it",
			},
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 8,
				size = 1,
				kind = "uint8",
				doc = "254 for any of it, 255 for all",
			},
		},
		most = 12,
	},
	cf_cancel = {
		name = "cf_cancel",
		protocol = "cfe",
		title = "CANCEL",
		size = 9,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.sequence",
				name = "sequence",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "of the transaction",
			},
			{
				abbreviation = "cfe.cf.entity_id",
				name = "entity_id",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "that began it",
			},
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 8,
				size = 1,
				kind = "uint8",
				doc = "254 for any of it, 255 for all",
			},
		},
		most = 12,
	},
	cf_abandon = {
		name = "cf_abandon",
		protocol = "cfe",
		title = "ABANDON",
		size = 9,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.sequence",
				name = "sequence",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "of the transaction",
			},
			{
				abbreviation = "cfe.cf.entity_id",
				name = "entity_id",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "that began it",
			},
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 8,
				size = 1,
				kind = "uint8",
				doc = "254 for any of it, 255 for all",
			},
		},
		most = 12,
	},
	cf_set_param = {
		name = "cf_set_param",
		protocol = "cfe",
		title = "SET_PARAM",
		size = 6,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.value",
				name = "value",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "new",
			},
			{
				abbreviation = "cfe.cf.parameter",
				name = "parameter",
				start = 4,
				size = 1,
				kind = "uint8",
				names = {
					[0] = "ticks_per_second",
					[1] = "rx_crc_bytes_per_wakeup",
					[2] = "ack_timer_s",
					[3] = "nak_timer_s",
					[4] = "inactivity_timer_s",
					[5] = "outgoing_chunk_size",
					[6] = "ack_limit",
					[7] = "nak_limit",
					[8] = "local_entity_id",
					[9] = "outgoing_messages_per_wakeup",
				},
				doc = "of CF's table",
			},
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 5,
				size = 1,
				kind = "uint8",
				doc = "where it has one for each",
				silent = true,
			},
		},
		most = 8,
	},
	cf_get_param = {
		name = "cf_get_param",
		protocol = "cfe",
		title = "GET_PARAM",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.parameter",
				name = "parameter",
				start = 0,
				size = 1,
				kind = "uint8",
				names = {
					[0] = "ticks_per_second",
					[1] = "rx_crc_bytes_per_wakeup",
					[2] = "ack_timer_s",
					[3] = "nak_timer_s",
					[4] = "inactivity_timer_s",
					[5] = "outgoing_chunk_size",
					[6] = "ack_limit",
					[7] = "nak_limit",
					[8] = "local_entity_id",
					[9] = "outgoing_messages_per_wakeup",
				},
				doc = "of CF's table",
			},
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "where it has one for each",
				silent = true,
			},
		},
		most = 2,
	},
	cf_write_queue = {
		name = "cf_write_queue",
		protocol = "cfe",
		title = "WRITE_QUEUE",
		size = 68,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.direction",
				name = "direction",
				start = 0,
				size = 1,
				kind = "uint8",
				names = {[0] = "all", [1] = "up", [2] = "down"},
				doc = "",
			},
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "255 for all",
			},
			{
				abbreviation = "cfe.cf.queue",
				name = "queue",
				start = 2,
				size = 1,
				kind = "uint8",
				names = {[0] = "pending", [1] = "active", [2] = "history", [3] = "all"},
				doc = "",
			},
			{
				abbreviation = "cfe.cf.file_name",
				name = "file_name",
				start = 4,
				size = 64,
				kind = "string",
				doc = "path on the flight computer",
			},
		},
		most = 68,
	},
	cf_enable_dequeue = {
		name = "cf_enable_dequeue",
		protocol = "cfe",
		title = "ENABLE_DEQUEUE",
		size = 1,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "255 for all",
			},
		},
		most = 4,
	},
	cf_disable_dequeue = {
		name = "cf_disable_dequeue",
		protocol = "cfe",
		title = "DISABLE_DEQUEUE",
		size = 1,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "255 for all",
			},
		},
		most = 4,
	},
	cf_enable_dir_polling = {
		name = "cf_enable_dir_polling",
		protocol = "cfe",
		title = "ENABLE_DIR_POLLING",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "255 for all",
			},
			{
				abbreviation = "cfe.cf.folder",
				name = "folder",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "place in the table; 255 for all",
			},
		},
		most = 4,
	},
	cf_disable_dir_polling = {
		name = "cf_disable_dir_polling",
		protocol = "cfe",
		title = "DISABLE_DIR_POLLING",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "255 for all",
			},
			{
				abbreviation = "cfe.cf.folder",
				name = "folder",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "place in the table; 255 for all",
			},
		},
		most = 4,
	},
	cf_purge_queue = {
		name = "cf_purge_queue",
		protocol = "cfe",
		title = "PURGE_QUEUE",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.cf.channel",
				name = "channel",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "255 for all",
			},
			{
				abbreviation = "cfe.cf.queues",
				name = "queues",
				start = 1,
				size = 1,
				kind = "uint8",
				names = {[0] = "pending", [1] = "history", [2] = "both"},
				doc = "",
			},
		},
		most = 4,
	},
	ds_set_app_state = {
		name = "ds_set_app_state",
		protocol = "cfe",
		title = "SET_APP_STATE",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.state",
				name = "state",
				start = 0,
				size = 2,
				kind = "uint16",
				names = {[0] = "disabled", [1] = "enabled"},
				doc = "",
			},
		},
		most = 4,
	},
	ds_set_filter_file = {
		name = "ds_set_filter_file",
		protocol = "cfe",
		title = "SET_FILTER_FILE",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.stream",
				name = "stream",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "MsgId",
			},
			{
				abbreviation = "cfe.ds.filter_index",
				name = "filter_index",
				start = 4,
				size = 2,
				kind = "uint16",
				doc = "which filter of it, from 0",
			},
			{
				abbreviation = "cfe.ds.file_index",
				name = "file_index",
				start = 6,
				size = 2,
				kind = "uint16",
				doc = "place in the destination file table",
			},
		},
		most = 8,
	},
	ds_set_filter_type = {
		name = "ds_set_filter_type",
		protocol = "cfe",
		title = "SET_FILTER_TYPE",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.stream",
				name = "stream",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "MsgId",
			},
			{
				abbreviation = "cfe.ds.filter_index",
				name = "filter_index",
				start = 4,
				size = 2,
				kind = "uint16",
				doc = "which filter of it, from 0",
			},
			{
				abbreviation = "cfe.ds.filter_type",
				name = "filter_type",
				start = 6,
				size = 2,
				kind = "uint16",
				names = {[1] = "by_count", [2] = "by_time"},
				doc = "",
			},
		},
		most = 8,
	},
	ds_set_filter_parms = {
		name = "ds_set_filter_parms",
		protocol = "cfe",
		title = "SET_FILTER_PARMS",
		size = 12,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.stream",
				name = "stream",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "MsgId",
			},
			{
				abbreviation = "cfe.ds.filter_index",
				name = "filter_index",
				start = 4,
				size = 2,
				kind = "uint16",
				doc = "which filter of it, from 0",
			},
			{
				abbreviation = "cfe.ds.pass_count",
				name = "pass_count",
				start = 6,
				size = 2,
				kind = "uint16",
				doc = "N: so many of X pass",
			},
			{
				abbreviation = "cfe.ds.of",
				name = "of",
				start = 8,
				size = 2,
				kind = "uint16",
				doc = "X",
			},
			{
				abbreviation = "cfe.ds.offset",
				name = "offset",
				start = 10,
				size = 2,
				kind = "uint16",
				doc = "O: of the first that passes",
			},
		},
		most = 12,
	},
	ds_set_dest_type = {
		name = "ds_set_dest_type",
		protocol = "cfe",
		title = "SET_DEST_TYPE",
		size = 4,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.file_index",
				name = "file_index",
				start = 0,
				size = 2,
				kind = "uint16",
				doc = "place in the destination file table",
			},
			{
				abbreviation = "cfe.ds.name_type",
				name = "name_type",
				start = 2,
				size = 2,
				kind = "uint16",
				names = {[1] = "by_count", [2] = "by_time"},
				doc = "of file names",
			},
		},
		most = 4,
	},
	ds_set_dest_state = {
		name = "ds_set_dest_state",
		protocol = "cfe",
		title = "SET_DEST_STATE",
		size = 4,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.file_index",
				name = "file_index",
				start = 0,
				size = 2,
				kind = "uint16",
				doc = "place in the destination file table",
			},
			{
				abbreviation = "cfe.ds.state",
				name = "state",
				start = 2,
				size = 2,
				kind = "uint16",
				names = {[0] = "disabled", [1] = "enabled"},
				doc = "",
			},
		},
		most = 4,
	},
	ds_set_dest_path = {
		name = "ds_set_dest_path",
		protocol = "cfe",
		title = "SET_DEST_PATH",
		size = 68,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.file_index",
				name = "file_index",
				start = 0,
				size = 2,
				kind = "uint16",
				doc = "place in the destination file table",
			},
			{
				abbreviation = "cfe.ds.folder",
				name = "folder",
				start = 4,
				size = 64,
				kind = "string",
				doc = "where files are written",
			},
		},
		most = 68,
	},
	ds_set_dest_base = {
		name = "ds_set_dest_base",
		protocol = "cfe",
		title = "SET_DEST_BASE",
		size = 24,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.file_index",
				name = "file_index",
				start = 0,
				size = 2,
				kind = "uint16",
				doc = "place in the destination file table",
			},
			{
				abbreviation = "cfe.ds.base_name",
				name = "base_name",
				start = 4,
				size = 20,
				kind = "string",
				doc = "of its files",
			},
		},
		most = 24,
	},
	ds_set_dest_ext = {
		name = "ds_set_dest_ext",
		protocol = "cfe",
		title = "SET_DEST_EXT",
		size = 12,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.file_index",
				name = "file_index",
				start = 0,
				size = 2,
				kind = "uint16",
				doc = "place in the destination file table",
			},
			{
				abbreviation = "cfe.ds.extension",
				name = "extension",
				start = 4,
				size = 8,
				kind = "string",
				doc = "of its files",
			},
		},
		most = 12,
	},
	ds_set_dest_size = {
		name = "ds_set_dest_size",
		protocol = "cfe",
		title = "SET_DEST_SIZE",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.file_index",
				name = "file_index",
				start = 0,
				size = 2,
				kind = "uint16",
				doc = "place in the destination file table",
			},
			{
				abbreviation = "cfe.ds.max_size",
				name = "max_size",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "bytes of a file",
			},
		},
		most = 8,
	},
	ds_set_dest_age = {
		name = "ds_set_dest_age",
		protocol = "cfe",
		title = "SET_DEST_AGE",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.file_index",
				name = "file_index",
				start = 0,
				size = 2,
				kind = "uint16",
				doc = "place in the destination file table",
			},
			{
				abbreviation = "cfe.ds.max_age",
				name = "max_age",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "s",
			},
		},
		most = 8,
	},
	ds_set_dest_count = {
		name = "ds_set_dest_count",
		protocol = "cfe",
		title = "SET_DEST_COUNT",
		size = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.file_index",
				name = "file_index",
				start = 0,
				size = 2,
				kind = "uint16",
				doc = "place in the destination file table",
			},
			{
				abbreviation = "cfe.ds.sequence",
				name = "sequence",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "in the next file's name",
			},
		},
		most = 8,
	},
	ds_close_file = {
		name = "ds_close_file",
		protocol = "cfe",
		title = "CLOSE_FILE",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.file_index",
				name = "file_index",
				start = 0,
				size = 2,
				kind = "uint16",
				doc = "place in the destination file table",
			},
		},
		most = 4,
	},
	ds_add_mid = {
		name = "ds_add_mid",
		protocol = "cfe",
		title = "ADD_MID",
		size = 4,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.stream",
				name = "stream",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "MsgId",
			},
		},
		most = 4,
	},
	ds_remove_mid = {
		name = "ds_remove_mid",
		protocol = "cfe",
		title = "REMOVE_MID",
		size = 4,
		little = true,
		fields = {
			{
				abbreviation = "cfe.ds.stream",
				name = "stream",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "MsgId",
			},
		},
		most = 4,
	},
	sbn_reset_peer = {
		name = "sbn_reset_peer",
		protocol = "cfe",
		title = "RESET_PEER",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.sbn.net",
				name = "net",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "place of the network in SBN's table",
			},
			{
				abbreviation = "cfe.sbn.peer",
				name = "peer",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "place of the peer there",
			},
		},
		most = 2,
	},
	sbn_hk_net = {
		name = "sbn_hk_net",
		protocol = "cfe",
		title = "HK_NET",
		size = 1,
		little = true,
		fields = {
			{
				abbreviation = "cfe.sbn.net",
				name = "net",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "place of the network in SBN's table",
			},
		},
		most = 1,
	},
	sbn_hk_peer = {
		name = "sbn_hk_peer",
		protocol = "cfe",
		title = "HK_PEER",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.sbn.net",
				name = "net",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "place of the network in SBN's table",
			},
			{
				abbreviation = "cfe.sbn.peer",
				name = "peer",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "place of the peer there",
			},
		},
		most = 2,
	},
	sbn_hk_peer_subs = {
		name = "sbn_hk_peer_subs",
		protocol = "cfe",
		title = "HK_PEER_SUBS",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.sbn.net",
				name = "net",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "place of the network in SBN's table",
			},
			{
				abbreviation = "cfe.sbn.peer",
				name = "peer",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "place of the peer there",
			},
		},
		most = 2,
	},
	sbn_hk_reset_peer = {
		name = "sbn_hk_reset_peer",
		protocol = "cfe",
		title = "HK_RESET_PEER",
		size = 2,
		little = true,
		fields = {
			{
				abbreviation = "cfe.sbn.net",
				name = "net",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "place of the network in SBN's table",
			},
			{
				abbreviation = "cfe.sbn.peer",
				name = "peer",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "place of the peer there",
			},
		},
		most = 2,
	},
	["struct 0x0800"] = {
		name = "CFE_ES_HousekeepingTlm",
		protocol = "cfe",
		title = "CFE_ES_HousekeepingTlm",
		size = 148,
		most = 148,
		little = true,
		fields = {
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.command_counter",
				name = "command_counter",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "ground commands accepted",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.command_error_counter",
				name = "command_error_counter",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "ground commands refused",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.cfe_checksum",
				name = "cfe_checksum",
				start = 2,
				size = 2,
				kind = "uint16",
				hex = true,
				doc = "of the cFE core's code",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.cfe_major",
				name = "cfe_major",
				start = 4,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.cfe_minor",
				name = "cfe_minor",
				start = 5,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.cfe_revision",
				name = "cfe_revision",
				start = 6,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.cfe_mission_revision",
				name = "cfe_mission_revision",
				start = 7,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.osal_major",
				name = "osal_major",
				start = 8,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.osal_minor",
				name = "osal_minor",
				start = 9,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.osal_revision",
				name = "osal_revision",
				start = 10,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.osal_mission_revision",
				name = "osal_mission_revision",
				start = 11,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.psp_major",
				name = "psp_major",
				start = 12,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.psp_minor",
				name = "psp_minor",
				start = 13,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.psp_revision",
				name = "psp_revision",
				start = 14,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.psp_mission_revision",
				name = "psp_mission_revision",
				start = 15,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.system_log_bytes_used",
				name = "system_log_bytes_used",
				start = 16,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.system_log_size",
				name = "system_log_size",
				start = 20,
				size = 4,
				kind = "uint32",
				doc = "bytes",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.system_log_entries",
				name = "system_log_entries",
				start = 24,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.system_log_mode",
				name = "system_log_mode",
				start = 28,
				size = 4,
				kind = "uint32",
				names = {[0] = "overwrite", [1] = "discard"},
				doc = "what a full system log does",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.reset_log_index",
				name = "reset_log_index",
				start = 32,
				size = 4,
				kind = "uint32",
				doc = "of the exception and reset log; it wraps around",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.reset_log_entries",
				name = "reset_log_entries",
				start = 36,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.registered_core_apps",
				name = "registered_core_apps",
				start = 40,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.registered_external_apps",
				name = "registered_external_apps",
				start = 44,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.registered_tasks",
				name = "registered_tasks",
				start = 48,
				size = 4,
				kind = "uint32",
				doc = "main and child tasks",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.registered_libraries",
				name = "registered_libraries",
				start = 52,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.reset_type",
				name = "reset_type",
				start = 56,
				size = 4,
				kind = "uint32",
				names = {[1] = "processor", [2] = "power_on"},
				doc = "of the last reset",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.reset_subtype",
				name = "reset_subtype",
				start = 60,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.processor_resets",
				name = "processor_resets",
				start = 64,
				size = 4,
				kind = "uint32",
				doc = "since the last power-on",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.max_processor_resets",
				name = "max_processor_resets",
				start = 68,
				size = 4,
				kind = "uint32",
				doc = "before a power-on reset is made",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.boot_source",
				name = "boot_source",
				start = 72,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_state",
				name = "perf_state",
				start = 76,
				size = 4,
				kind = "uint32",
				names = {[0] = "idle", [1] = "waiting", [2] = "triggered"},
				doc = "of the performance analyzer",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_mode",
				name = "perf_mode",
				start = 80,
				size = 4,
				kind = "uint32",
				names = {[0] = "start", [1] = "center", [2] = "end"},
				doc = "where its trigger lies in what it keeps",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_trigger_count",
				name = "perf_trigger_count",
				start = 84,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_filter_mask",
				name = "perf_filter_mask",
				start = 88,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_filter_mask",
				name = "perf_filter_mask",
				start = 92,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_filter_mask",
				name = "perf_filter_mask",
				start = 96,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_filter_mask",
				name = "perf_filter_mask",
				start = 100,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_trigger_mask",
				name = "perf_trigger_mask",
				start = 104,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_trigger_mask",
				name = "perf_trigger_mask",
				start = 108,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_trigger_mask",
				name = "perf_trigger_mask",
				start = 112,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_trigger_mask",
				name = "perf_trigger_mask",
				start = 116,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_data_start",
				name = "perf_data_start",
				start = 120,
				size = 4,
				kind = "uint32",
				doc = "first entry kept",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_data_end",
				name = "perf_data_end",
				start = 124,
				size = 4,
				kind = "uint32",
				doc = "last entry kept",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_data_count",
				name = "perf_data_count",
				start = 128,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.perf_data_to_write",
				name = "perf_data_to_write",
				start = 132,
				size = 4,
				kind = "uint32",
				doc = "entries not yet in the file",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.heap_bytes_free",
				name = "heap_bytes_free",
				start = 136,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.heap_blocks_free",
				name = "heap_blocks_free",
				start = 140,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_HousekeepingTlm.heap_max_block_size",
				name = "heap_max_block_size",
				start = 144,
				size = 4,
				kind = "uint32",
				doc = "largest block that is free",
			},
		},
	},
	["struct 0x0801"] = {
		name = "CFE_EVS_HousekeepingTlm",
		protocol = "cfe",
		title = "CFE_EVS_HousekeepingTlm",
		size = 16,
		most = 65535,
		step = 8,
		little = true,
		fields = {
			{
				abbreviation = "cfs.CFE_EVS_HousekeepingTlm.command_counter",
				name = "command_counter",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "ground commands accepted",
			},
			{
				abbreviation = "cfs.CFE_EVS_HousekeepingTlm.command_error_counter",
				name = "command_error_counter",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "ground commands refused",
			},
			{
				abbreviation = "cfs.CFE_EVS_HousekeepingTlm.message_format",
				name = "message_format",
				start = 2,
				size = 1,
				kind = "uint8",
				names = {[0] = "short", [1] = "long"},
				doc = "of events",
			},
			{
				abbreviation = "cfs.CFE_EVS_HousekeepingTlm.messages_truncated",
				name = "messages_truncated",
				start = 3,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_EVS_HousekeepingTlm.unregistered_app_counter",
				name = "unregistered_app_counter",
				start = 4,
				size = 1,
				kind = "uint8",
				doc = "events of apps that had not registered",
			},
			{
				abbreviation = "cfs.CFE_EVS_HousekeepingTlm.output_ports",
				name = "output_ports",
				start = 5,
				size = 1,
				kind = "uint8",
				hex = true,
				doc = "a bit each",
			},
			{
				abbreviation = "cfs.CFE_EVS_HousekeepingTlm.log_full",
				name = "log_full",
				start = 6,
				size = 1,
				kind = "uint8",
				names = {[0] = "false", [1] = "true"},
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_EVS_HousekeepingTlm.log_mode",
				name = "log_mode",
				start = 7,
				size = 1,
				kind = "uint8",
				names = {[0] = "overwrite", [1] = "discard"},
				doc = "what a full event log does",
			},
			{
				abbreviation = "cfs.CFE_EVS_HousekeepingTlm.messages_sent",
				name = "messages_sent",
				start = 8,
				size = 2,
				kind = "uint16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_EVS_HousekeepingTlm.log_overflow_counter",
				name = "log_overflow_counter",
				start = 10,
				size = 2,
				kind = "uint16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_EVS_HousekeepingTlm.log_enabled",
				name = "log_enabled",
				start = 12,
				size = 1,
				kind = "uint8",
				names = {[0] = "false", [1] = "true"},
				doc = "",
			},
		},
	},
	["struct 0x0804"] = {
		name = "CFE_TBL_HousekeepingTlm",
		protocol = "cfe",
		title = "CFE_TBL_HousekeepingTlm",
		size = 284,
		most = 284,
		little = true,
		fields = {
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.command_counter",
				name = "command_counter",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "ground commands accepted",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.command_error_counter",
				name = "command_error_counter",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "ground commands refused",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.tables",
				name = "tables",
				start = 2,
				size = 2,
				kind = "uint16",
				doc = "registered",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.loads_pending",
				name = "loads_pending",
				start = 4,
				size = 2,
				kind = "uint16",
				doc = "tables that wait for their app",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.validation_counter",
				name = "validation_counter",
				start = 6,
				size = 2,
				kind = "uint16",
				doc = "validations completed",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.last_validation_crc",
				name = "last_validation_crc",
				start = 8,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.last_validation_status",
				name = "last_validation_status",
				start = 12,
				size = 4,
				kind = "int32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.active_buffer",
				name = "active_buffer",
				start = 16,
				size = 1,
				kind = "uint8",
				names = {[0] = "false", [1] = "true"},
				doc = "whether the active buffer was validated",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.last_validated_table",
				name = "last_validated_table",
				start = 17,
				size = 40,
				kind = "string",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.validation_success_counter",
				name = "validation_success_counter",
				start = 57,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.validation_failure_counter",
				name = "validation_failure_counter",
				start = 58,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.validation_request_counter",
				name = "validation_request_counter",
				start = 59,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.free_shared_buffers",
				name = "free_shared_buffers",
				start = 60,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.memory_pool_handle",
				name = "memory_pool_handle",
				start = 64,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.last_update_time.seconds",
				name = "last_update_time.seconds",
				start = 68,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.last_update_time.subseconds",
				name = "last_update_time.subseconds",
				start = 72,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.last_updated_table",
				name = "last_updated_table",
				start = 76,
				size = 40,
				kind = "string",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.last_file_loaded",
				name = "last_file_loaded",
				start = 116,
				size = 64,
				kind = "string",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.last_file_dumped",
				name = "last_file_dumped",
				start = 180,
				size = 64,
				kind = "string",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TBL_HousekeepingTlm.last_table_loaded",
				name = "last_table_loaded",
				start = 244,
				size = 40,
				kind = "string",
				doc = "",
			},
		},
	},
	["struct 0x0805"] = {
		name = "CFE_TIME_HousekeepingTlm",
		protocol = "cfe",
		title = "CFE_TIME_HousekeepingTlm",
		size = 32,
		most = 32,
		little = true,
		fields = {
			{
				abbreviation = "cfs.CFE_TIME_HousekeepingTlm.command_counter",
				name = "command_counter",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "ground commands accepted",
			},
			{
				abbreviation = "cfs.CFE_TIME_HousekeepingTlm.command_error_counter",
				name = "command_error_counter",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "ground commands refused",
			},
			{
				abbreviation = "cfs.CFE_TIME_HousekeepingTlm.clock_state_flags",
				name = "clock_state_flags",
				start = 2,
				size = 2,
				kind = "uint16",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_HousekeepingTlm.clock_state",
				name = "clock_state",
				start = 4,
				size = 2,
				kind = "int16",
				names = {[-1] = "invalid", [0] = "valid", [1] = "flywheel"},
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_HousekeepingTlm.leap_seconds",
				name = "leap_seconds",
				start = 6,
				size = 2,
				kind = "int16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_HousekeepingTlm.met_seconds",
				name = "met_seconds",
				start = 8,
				size = 4,
				kind = "uint32",
				doc = "mission elapsed time",
			},
			{
				abbreviation = "cfs.CFE_TIME_HousekeepingTlm.met_subseconds",
				name = "met_subseconds",
				start = 12,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_HousekeepingTlm.stcf_seconds",
				name = "stcf_seconds",
				start = 16,
				size = 4,
				kind = "uint32",
				doc = "what is added to it, the spacecraft time correlation factor",
			},
			{
				abbreviation = "cfs.CFE_TIME_HousekeepingTlm.stcf_subseconds",
				name = "stcf_subseconds",
				start = 20,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_HousekeepingTlm.adjust_seconds",
				name = "adjust_seconds",
				start = 24,
				size = 4,
				kind = "uint32",
				doc = "of a server 1 Hz adjustment, of a client delay",
			},
			{
				abbreviation = "cfs.CFE_TIME_HousekeepingTlm.adjust_subseconds",
				name = "adjust_subseconds",
				start = 28,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
		},
	},
	["struct 0x0806"] = {
		name = "CFE_TIME_DiagnosticTlm",
		protocol = "cfe",
		title = "CFE_TIME_DiagnosticTlm",
		size = 200,
		most = 200,
		little = true,
		fields = {
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_met.seconds",
				name = "tone_met.seconds",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_met.subseconds",
				name = "tone_met.subseconds",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_stcf.seconds",
				name = "tone_stcf.seconds",
				start = 8,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_stcf.subseconds",
				name = "tone_stcf.subseconds",
				start = 12,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_delay.seconds",
				name = "tone_delay.seconds",
				start = 16,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_delay.subseconds",
				name = "tone_delay.subseconds",
				start = 20,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_latch.seconds",
				name = "tone_latch.seconds",
				start = 24,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_latch.subseconds",
				name = "tone_latch.subseconds",
				start = 28,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_leap_seconds",
				name = "tone_leap_seconds",
				start = 32,
				size = 2,
				kind = "int16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.clock_state",
				name = "clock_state",
				start = 34,
				size = 2,
				kind = "int16",
				names = {[-1] = "invalid", [0] = "valid", [1] = "flywheel"},
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.since_tone.seconds",
				name = "since_tone.seconds",
				start = 36,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.since_tone.subseconds",
				name = "since_tone.subseconds",
				start = 40,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.current_latch.seconds",
				name = "current_latch.seconds",
				start = 44,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.current_latch.subseconds",
				name = "current_latch.subseconds",
				start = 48,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.current_met.seconds",
				name = "current_met.seconds",
				start = 52,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.current_met.subseconds",
				name = "current_met.subseconds",
				start = 56,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tai.seconds",
				name = "tai.seconds",
				start = 60,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tai.subseconds",
				name = "tai.subseconds",
				start = 64,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.utc.seconds",
				name = "utc.seconds",
				start = 68,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.utc.subseconds",
				name = "utc.subseconds",
				start = 72,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.clock_set",
				name = "clock_set",
				start = 76,
				size = 2,
				kind = "int16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.flywheel",
				name = "flywheel",
				start = 78,
				size = 2,
				kind = "int16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.clock_source",
				name = "clock_source",
				start = 80,
				size = 2,
				kind = "int16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.clock_signal",
				name = "clock_signal",
				start = 82,
				size = 2,
				kind = "int16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.server_flywheel",
				name = "server_flywheel",
				start = 84,
				size = 2,
				kind = "int16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.forced_flywheel",
				name = "forced_flywheel",
				start = 86,
				size = 2,
				kind = "int16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.clock_state_flags",
				name = "clock_state_flags",
				start = 88,
				size = 2,
				kind = "uint16",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.one_time_direction",
				name = "one_time_direction",
				start = 90,
				size = 2,
				kind = "int16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.one_hz_direction",
				name = "one_hz_direction",
				start = 92,
				size = 2,
				kind = "int16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.delay_direction",
				name = "delay_direction",
				start = 94,
				size = 2,
				kind = "int16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.one_time_adjust.seconds",
				name = "one_time_adjust.seconds",
				start = 96,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.one_time_adjust.subseconds",
				name = "one_time_adjust.subseconds",
				start = 100,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.one_hz_adjust.seconds",
				name = "one_hz_adjust.seconds",
				start = 104,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.one_hz_adjust.subseconds",
				name = "one_hz_adjust.subseconds",
				start = 108,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.signal_latch.seconds",
				name = "signal_latch.seconds",
				start = 112,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.signal_latch.subseconds",
				name = "signal_latch.subseconds",
				start = 116,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.data_latch.seconds",
				name = "data_latch.seconds",
				start = 120,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.data_latch.subseconds",
				name = "data_latch.subseconds",
				start = 124,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_match_counter",
				name = "tone_match_counter",
				start = 128,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_match_error_counter",
				name = "tone_match_error_counter",
				start = 132,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_signal_counter",
				name = "tone_signal_counter",
				start = 136,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_data_counter",
				name = "tone_data_counter",
				start = 140,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_interrupt_counter",
				name = "tone_interrupt_counter",
				start = 144,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_interrupt_error_counter",
				name = "tone_interrupt_error_counter",
				start = 148,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_task_counter",
				name = "tone_task_counter",
				start = 152,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.version_counter",
				name = "version_counter",
				start = 156,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.local_interrupt_counter",
				name = "local_interrupt_counter",
				start = 160,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.local_task_counter",
				name = "local_task_counter",
				start = 164,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.virtual_met",
				name = "virtual_met",
				start = 168,
				size = 4,
				kind = "uint32",
				doc = "s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.min_elapsed",
				name = "min_elapsed",
				start = 172,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.max_elapsed",
				name = "max_elapsed",
				start = 176,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.max_local_clock.seconds",
				name = "max_local_clock.seconds",
				start = 180,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.max_local_clock.subseconds",
				name = "max_local_clock.subseconds",
				start = 184,
				size = 4,
				kind = "uint32",
				doc = "1/2^32 s",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_over_limit",
				name = "tone_over_limit",
				start = 188,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.tone_under_limit",
				name = "tone_under_limit",
				start = 192,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_TIME_DiagnosticTlm.data_store_status",
				name = "data_store_status",
				start = 196,
				size = 4,
				kind = "int32",
				doc = "",
			},
		},
	},
	["struct 0x080a"] = {
		name = "CFE_SB_StatsTlm",
		protocol = "cfe",
		title = "CFE_SB_StatsTlm",
		size = 60,
		most = 65535,
		step = 12,
		little = true,
		fields = {
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.msg_ids_in_use",
				name = "msg_ids_in_use",
				start = 0,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.peak_msg_ids_in_use",
				name = "peak_msg_ids_in_use",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.max_msg_ids_allowed",
				name = "max_msg_ids_allowed",
				start = 8,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.pipes_in_use",
				name = "pipes_in_use",
				start = 12,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.peak_pipes_in_use",
				name = "peak_pipes_in_use",
				start = 16,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.max_pipes_allowed",
				name = "max_pipes_allowed",
				start = 20,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.memory_in_use",
				name = "memory_in_use",
				start = 24,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.peak_memory_in_use",
				name = "peak_memory_in_use",
				start = 28,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.max_memory_allowed",
				name = "max_memory_allowed",
				start = 32,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.subscriptions_in_use",
				name = "subscriptions_in_use",
				start = 36,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.peak_subscriptions_in_use",
				name = "peak_subscriptions_in_use",
				start = 40,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.max_subscriptions_allowed",
				name = "max_subscriptions_allowed",
				start = 44,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.buffers_in_use",
				name = "buffers_in_use",
				start = 48,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.peak_buffers_in_use",
				name = "peak_buffers_in_use",
				start = 52,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_SB_StatsTlm.max_pipe_depth_allowed",
				name = "max_pipe_depth_allowed",
				start = 56,
				size = 4,
				kind = "uint32",
				doc = "",
			},
		},
	},
	["struct 0x080b"] = {
		name = "CFE_ES_OneAppTlm",
		protocol = "cfe",
		title = "CFE_ES_OneAppTlm",
		size = 184,
		most = 184,
		little = true,
		fields = {
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.resource_id",
				name = "resource_id",
				start = 0,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.type",
				name = "type",
				start = 4,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.name",
				name = "name",
				start = 8,
				size = 20,
				kind = "string",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.entry_point",
				name = "entry_point",
				start = 28,
				size = 20,
				kind = "string",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.file_name",
				name = "file_name",
				start = 48,
				size = 64,
				kind = "string",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.stack_size",
				name = "stack_size",
				start = 112,
				size = 4,
				kind = "uint32",
				doc = "bytes",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.addresses_valid",
				name = "addresses_valid",
				start = 116,
				size = 4,
				kind = "uint32",
				names = {[0] = "false", [1] = "true"},
				doc = "whether the following are known",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.code_address",
				name = "code_address",
				start = 120,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.code_size",
				name = "code_size",
				start = 124,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.data_address",
				name = "data_address",
				start = 128,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.data_size",
				name = "data_size",
				start = 132,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.bss_address",
				name = "bss_address",
				start = 136,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.bss_size",
				name = "bss_size",
				start = 140,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.start_address",
				name = "start_address",
				start = 144,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.exception_action",
				name = "exception_action",
				start = 148,
				size = 2,
				kind = "uint16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.priority",
				name = "priority",
				start = 150,
				size = 2,
				kind = "uint16",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.main_task_id",
				name = "main_task_id",
				start = 152,
				size = 4,
				kind = "uint32",
				hex = true,
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.execution_counter",
				name = "execution_counter",
				start = 156,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.main_task_name",
				name = "main_task_name",
				start = 160,
				size = 20,
				kind = "string",
				doc = "",
			},
			{
				abbreviation = "cfs.CFE_ES_OneAppTlm.child_tasks",
				name = "child_tasks",
				start = 180,
				size = 4,
				kind = "uint32",
				doc = "",
			},
		},
	},
	["struct 0x0880"] = {
		name = "TO_LAB_HkTlm",
		protocol = "cfe",
		title = "TO_LAB_HkTlm",
		size = 4,
		most = 4,
		little = true,
		fields = {
			{
				abbreviation = "cfs.TO_LAB_HkTlm.command_counter",
				name = "command_counter",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "ground commands accepted",
			},
			{
				abbreviation = "cfs.TO_LAB_HkTlm.command_error_counter",
				name = "command_error_counter",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "ground commands refused",
			},
			{
				abbreviation = "cfs.TO_LAB_HkTlm.spare",
				name = "spare",
				start = 2,
				size = 1,
				kind = "uint8",
				doc = "",
			},
			{
				abbreviation = "cfs.TO_LAB_HkTlm.spare",
				name = "spare",
				start = 3,
				size = 1,
				kind = "uint8",
				doc = "",
			},
		},
	},
	["struct 0x0884"] = {
		name = "CI_LAB_HkTlm",
		protocol = "cfe",
		title = "CI_LAB_HkTlm",
		size = 24,
		most = 24,
		little = true,
		fields = {
			{
				abbreviation = "cfs.CI_LAB_HkTlm.command_error_counter",
				name = "command_error_counter",
				start = 0,
				size = 1,
				kind = "uint8",
				doc = "ground commands refused",
			},
			{
				abbreviation = "cfs.CI_LAB_HkTlm.command_counter",
				name = "command_counter",
				start = 1,
				size = 1,
				kind = "uint8",
				doc = "ground commands accepted",
			},
			{
				abbreviation = "cfs.CI_LAB_HkTlm.checksums_enabled",
				name = "checksums_enabled",
				start = 2,
				size = 1,
				kind = "uint8",
				names = {[0] = "false", [1] = "true"},
				doc = "",
			},
			{
				abbreviation = "cfs.CI_LAB_HkTlm.socket_connected",
				name = "socket_connected",
				start = 3,
				size = 1,
				kind = "uint8",
				names = {[0] = "false", [1] = "true"},
				doc = "",
			},
			{
				abbreviation = "cfs.CI_LAB_HkTlm.ingest_packets",
				name = "ingest_packets",
				start = 12,
				size = 4,
				kind = "uint32",
				doc = "datagrams taken in",
			},
			{
				abbreviation = "cfs.CI_LAB_HkTlm.ingest_errors",
				name = "ingest_errors",
				start = 16,
				size = 4,
				kind = "uint32",
				doc = "",
			},
			{
				abbreviation = "cfs.CI_LAB_HkTlm.spare",
				name = "spare",
				start = 20,
				size = 4,
				kind = "uint32",
				doc = "",
			},
		},
	},
}
D.formats = {
	{
		reader = "envelope_1",
		size = 16,
		little = true,
		words = {{name = "buffer_length", at = 0, size = 8}, {name = "buffer_capacity", at = 8, size = 8}},
	},
	{
		reader = "envelope_2",
		size = 16,
		little = false,
		words = {{name = "buffer_length", at = 0, size = 8}, {name = "buffer_capacity", at = 8, size = 8}},
	},
	{
		reader = "envelope_3",
		size = 8,
		little = true,
		words = {{name = "buffer_length", at = 0, size = 4}, {name = "buffer_capacity", at = 4, size = 4}},
	},
	{
		reader = "envelope_4",
		size = 8,
		little = false,
		words = {{name = "buffer_length", at = 0, size = 4}, {name = "buffer_capacity", at = 4, size = 4}},
	},
	{
		reader = "envelope_5",
		size = 4,
		little = true,
		words = {{name = "buffer_length", at = 0, size = 2}, {name = "buffer_capacity", at = 2, size = 2}},
	},
	{
		reader = "envelope_6",
		size = 4,
		little = false,
		words = {{name = "buffer_length", at = 0, size = 2}, {name = "buffer_capacity", at = 2, size = 2}},
	},
	{
		reader = "envelope_7",
		size = 2,
		little = true,
		words = {{name = "buffer_length", at = 0, size = 1}, {name = "buffer_capacity", at = 1, size = 1}},
	},
}
D.limits = {
	bridge_modulus = 256,
	software_bus = 32768,
	highest_msg_id = 8191,
	length_bias = 7,
	rounded = 3,
	sequence_modulus = 16384,
}
D.sbn = {
	NO_MSG = 0,
	SUB = 1,
	UNSUB = 2,
	APP = 3,
	PROTO = 4,
	HEARTBEAT = 160,
	ANNOUNCE = 161,
	DISCONNECT = 162,
	names = {
		[0] = "NO_MSG",
		[1] = "SUB",
		[2] = "UNSUB",
		[3] = "APP",
		[4] = "PROTO",
		[160] = "HEARTBEAT",
		[161] = "ANNOUNCE",
		[162] = "DISCONNECT",
	},
	version = 11,
	ident = "$Id: dccf6239093d99c4c9351e140c15b61a95d8fc37 $",
	ident_bytes = 48,
}
D.pdu_name = "CFDP_PDU"
D.pdu_msg_ids = {}
D.msg_id = {event = 2056, software_bus = 2051}
D.msg_id_names = {
	[2048] = "ES_HK",
	[2049] = "EVS_HK",
	[2051] = "SB_HK",
	[2052] = "TBL_HK",
	[2053] = "TIME_HK",
	[2054] = "TIME_DIAG",
	[2056] = "EVS_LONG_EVENT",
	[2057] = "EVS_SHORT_EVENT",
	[2058] = "SB_STATS",
	[2059] = "ES_APP_INFO",
	[2060] = "TBL_REGISTRY",
	[2061] = "SB_ALL_SUBSCRIPTIONS",
	[2062] = "SB_ONE_SUBSCRIPTION",
	[2064] = "ES_MEMORY_STATS",
	[2086] = "EDORAS_APP_HK",
	[2176] = "TO_HK",
	[2177] = "TO_DATA_TYPES",
	[2179] = "SAMPLE_HK",
	[2180] = "CI_HK",
	[2298] = "SBN_HK",
	[6145] = "EVS_CMD",
	[6147] = "SB_CMD",
	[6148] = "TBL_CMD",
	[6149] = "TIME_CMD",
	[6150] = "ES_CMD",
	[6152] = "ES_SEND_HK",
	[6153] = "EVS_SEND_HK",
	[6155] = "SB_SEND_HK",
	[6156] = "TBL_SEND_HK",
	[6157] = "TIME_SEND_HK",
	[6158] = "SB_REPORT_CONTROL",
	[6160] = "TIME_TONE",
	[6161] = "TIME_ONE_HZ",
	[6240] = "TIME_DATA",
	[6242] = "TIME_SEND",
	[6272] = "TO_CMD",
	[6273] = "TO_SEND_HK",
	[6274] = "SAMPLE_CMD",
	[6275] = "SAMPLE_SEND_HK",
	[6276] = "CI_CMD",
	[6277] = "CI_SEND_HK",
	[6293] = "SCH_CMD",
	[6323] = "CF_CMD",
	[6331] = "DS_CMD",
	[6394] = "SBN_CMD",
}
D.commands = {
	[6145] = {
		[0] = {name = "NOOP", lengths = {8}},
		[1] = {name = "RESET_COUNTERS", lengths = {8}},
		[2] = {name = "ENABLE_EVENT_TYPE"},
		[3] = {name = "DISABLE_EVENT_TYPE"},
		[4] = {name = "SET_EVENT_FORMAT_MODE"},
		[5] = {name = "ENABLE_APP_EVENT_TYPE"},
		[6] = {name = "DISABLE_APP_EVENT_TYPE"},
		[7] = {name = "ENABLE_APP_EVENTS"},
		[8] = {name = "DISABLE_APP_EVENTS"},
		[9] = {name = "RESET_APP_COUNTER"},
		[10] = {name = "SET_FILTER"},
		[11] = {name = "ENABLE_PORTS"},
		[12] = {name = "DISABLE_PORTS"},
		[13] = {name = "RESET_FILTER"},
		[14] = {name = "RESET_ALL_FILTERS"},
		[15] = {name = "ADD_EVENT_FILTER"},
		[16] = {name = "DELETE_EVENT_FILTER"},
		[17] = {name = "WRITE_APP_DATA_FILE"},
		[18] = {name = "WRITE_LOG_DATA_FILE"},
		[19] = {name = "SET_LOG_MODE"},
		[20] = {name = "CLEAR_LOG"},
	},
	[6147] = {
		[0] = {name = "NOOP", lengths = {8}},
		[1] = {name = "RESET_COUNTERS", lengths = {8}},
		[2] = {name = "SEND_SB_STATS", lengths = {8}},
		[3] = {name = "WRITE_ROUTING_INFO"},
		[4] = {name = "ENABLE_ROUTE"},
		[5] = {name = "DISABLE_ROUTE"},
		[7] = {name = "WRITE_PIPE_INFO"},
		[8] = {name = "WRITE_MAP_INFO"},
		[9] = {name = "ENABLE_SUB_REPORTING"},
		[10] = {name = "DISABLE_SUB_REPORTING"},
		[11] = {name = "SEND_PREV_SUBS"},
	},
	[6148] = {
		[0] = {name = "NOOP", lengths = {8}},
		[1] = {name = "RESET_COUNTERS", lengths = {8}},
		[2] = {name = "LOAD"},
		[3] = {name = "DUMP"},
		[4] = {name = "VALIDATE"},
		[5] = {name = "ACTIVATE"},
		[6] = {name = "DUMP_REGISTRY"},
		[7] = {name = "SEND_REGISTRY"},
		[8] = {name = "DELETE_CDS"},
		[9] = {name = "ABORT_LOAD"},
	},
	[6149] = {
		[0] = {name = "NOOP", lengths = {8}},
		[1] = {name = "RESET_COUNTERS", lengths = {8}},
		[2] = {name = "SEND_DIAGNOSTIC", lengths = {8}},
		[3] = {name = "SET_SOURCE", lengths = {10}},
		[4] = {name = "SET_STATE", lengths = {10}},
		[5] = {name = "ADD_DELAY", lengths = {16}},
		[6] = {name = "SUB_DELAY", lengths = {16}},
		[7] = {name = "SET_TIME", lengths = {16}},
		[8] = {name = "SET_MET", lengths = {16}},
		[9] = {name = "SET_STCF", lengths = {16}},
		[10] = {name = "SET_LEAP_SECONDS", lengths = {10}},
		[11] = {name = "ADD_ADJUST", lengths = {16}},
		[12] = {name = "SUB_ADJUST", lengths = {16}},
		[13] = {name = "ADD_ONE_HZ", lengths = {16}},
		[14] = {name = "SUB_ONE_HZ", lengths = {16}},
		[15] = {name = "SET_SIGNAL", lengths = {10}},
	},
	[6150] = {
		[0] = {name = "NOOP", lengths = {8}},
		[1] = {name = "RESET_COUNTERS", lengths = {8}},
		[2] = {name = "RESTART"},
		[4] = {name = "START_APP"},
		[5] = {name = "STOP_APP"},
		[6] = {name = "RESTART_APP"},
		[7] = {name = "RELOAD_APP"},
		[8] = {name = "QUERY_ONE"},
		[9] = {name = "QUERY_ALL"},
		[10] = {name = "CLEAR_SYS_LOG"},
		[11] = {name = "WRITE_SYS_LOG"},
		[12] = {name = "CLEAR_ER_LOG"},
		[13] = {name = "WRITE_ER_LOG"},
		[14] = {name = "START_PERF_DATA"},
		[15] = {name = "STOP_PERF_DATA"},
		[16] = {name = "SET_PERF_FILTER_MASK"},
		[17] = {name = "SET_PERF_TRIGGER_MASK"},
		[18] = {name = "OVER_WRITE_SYS_LOG"},
		[19] = {name = "RESET_PR_COUNT"},
		[20] = {name = "SET_MAX_PR_COUNT"},
		[21] = {name = "DELETE_CDS"},
		[22] = {name = "SEND_MEM_POOL_STATS"},
		[23] = {name = "DUMP_CDS_REGISTRY"},
		[24] = {name = "QUERY_ALL_TASKS"},
	},
	[6272] = {
		[0] = {name = "NOOP", lengths = {8}},
		[1] = {name = "RESET_COUNTERS", lengths = {8}},
		[2] = {name = "ADD_PKT", lengths = {16, 20}},
		[3] = {name = "SEND_DATA_TYPES", lengths = {8}},
		[4] = {name = "REMOVE_PKT", lengths = {12}},
		[5] = {name = "REMOVE_ALL", lengths = {8}},
		[6] = {name = "ENABLE_OUTPUT", lengths = {24, 28}},
	},
	[6276] = {[0] = {name = "NOOP", lengths = {8}}, [1] = {name = "RESET_COUNTERS", lengths = {8}}},
}
D.arguments = {
	[6145] = {
		[2] = "evs_enable_event_type",
		[3] = "evs_disable_event_type",
		[4] = "evs_set_event_format_mode",
		[5] = "evs_enable_app_event_type",
		[6] = "evs_disable_app_event_type",
		[7] = "evs_enable_app_events",
		[8] = "evs_disable_app_events",
		[9] = "evs_reset_app_counter",
		[10] = "evs_set_filter",
		[11] = "evs_enable_ports",
		[12] = "evs_disable_ports",
		[13] = "evs_reset_filter",
		[14] = "evs_reset_all_filters",
		[15] = "evs_add_event_filter",
		[16] = "evs_delete_event_filter",
		[17] = "evs_write_app_data_file",
		[18] = "evs_write_log_data_file",
		[19] = "evs_set_log_mode",
	},
	[6147] = {
		[3] = "sb_write_routing_info",
		[4] = "sb_enable_route",
		[5] = "sb_disable_route",
		[7] = "sb_write_pipe_info",
		[8] = "sb_write_map_info",
	},
	[6148] = {
		[2] = "tbl_load",
		[3] = "tbl_dump",
		[4] = "tbl_validate",
		[5] = "tbl_activate",
		[6] = "tbl_dump_registry",
		[7] = "tbl_send_registry",
		[8] = "tbl_delete_cds",
		[9] = "tbl_abort_load",
	},
	[6149] = {
		[3] = "time_set_source",
		[4] = "time_set_state",
		[5] = "time_add_delay",
		[6] = "time_sub_delay",
		[7] = "time_set_time",
		[8] = "time_set_met",
		[9] = "time_set_stcf",
		[10] = "time_set_leap_seconds",
		[11] = "time_add_adjust",
		[12] = "time_sub_adjust",
		[13] = "time_add_one_hz",
		[14] = "time_sub_one_hz",
		[15] = "time_set_signal",
	},
	[6150] = {
		[2] = "es_restart",
		[4] = "es_start_app",
		[5] = "es_stop_app",
		[6] = "es_restart_app",
		[7] = "es_reload_app",
		[8] = "es_query_one",
		[9] = "es_query_all",
		[11] = "es_write_sys_log",
		[13] = "es_write_er_log",
		[14] = "es_start_perf_data",
		[15] = "es_stop_perf_data",
		[16] = "es_set_perf_filter_mask",
		[17] = "es_set_perf_trigger_mask",
		[18] = "es_over_write_sys_log",
		[20] = "es_set_max_pr_count",
		[21] = "es_delete_cds",
		[22] = "es_send_mem_pool_stats",
		[23] = "es_dump_cds_registry",
		[24] = "es_query_all_tasks",
	},
	[6272] = {[2] = "to_add_pkt", [4] = "to_remove_pkt", [6] = "to_enable_output"},
	[6293] = {[2] = "sch_enable", [3] = "sch_disable", [4] = "sch_enable_group", [5] = "sch_disable_group"},
	[6323] = {
		[1] = "cf_reset_counters",
		[2] = "cf_tx_file",
		[3] = "cf_playback_dir",
		[4] = "cf_freeze",
		[5] = "cf_thaw",
		[6] = "cf_suspend",
		[7] = "cf_resume",
		[8] = "cf_cancel",
		[9] = "cf_abandon",
		[10] = "cf_set_param",
		[11] = "cf_get_param",
		[15] = "cf_write_queue",
		[16] = "cf_enable_dequeue",
		[17] = "cf_disable_dequeue",
		[18] = "cf_enable_dir_polling",
		[19] = "cf_disable_dir_polling",
		[21] = "cf_purge_queue",
	},
	[6331] = {
		[2] = "ds_set_app_state",
		[3] = "ds_set_filter_file",
		[4] = "ds_set_filter_type",
		[5] = "ds_set_filter_parms",
		[6] = "ds_set_dest_type",
		[7] = "ds_set_dest_state",
		[8] = "ds_set_dest_path",
		[9] = "ds_set_dest_base",
		[10] = "ds_set_dest_ext",
		[11] = "ds_set_dest_size",
		[12] = "ds_set_dest_age",
		[13] = "ds_set_dest_count",
		[14] = "ds_close_file",
		[16] = "ds_add_mid",
		[17] = "ds_remove_mid",
	},
	[6394] = {
		[2] = "sbn_reset_peer",
		[11] = "sbn_hk_net",
		[12] = "sbn_hk_peer",
		[13] = "sbn_hk_peer_subs",
		[16] = "sbn_hk_reset_peer",
	},
}
D.structs = {
	[2048] = {[-1] = "struct 0x0800"},
	[2049] = {[-1] = "struct 0x0801"},
	[2052] = {[-1] = "struct 0x0804"},
	[2053] = {[-1] = "struct 0x0805"},
	[2054] = {[-1] = "struct 0x0806"},
	[2058] = {[-1] = "struct 0x080a"},
	[2059] = {[-1] = "struct 0x080b"},
	[2176] = {[-1] = "struct 0x0880"},
	[2180] = {[-1] = "struct 0x0884"},
}
D.route_commands = {[0] = {name = "NOOP", lengths = {8}}, [1] = {name = "SET"}}
D.findings = {
	{
		label = "truncated",
		severity = "error",
		short = "truncated",
		meaning = "A layer needs more bytes than the datagram has; CI drops commands shorter than 8 bytes, and an app that gets a cut one cannot read it, or reads old bytes of its buffer.",
		unknowable = true,
	},
	{
		label = "length_mismatch",
		severity = "warning",
		short = "length field",
		meaning = "The packet data length field differs from the number of bytes received; CI accepts that silently.",
		unknowable = true,
	},
	{
		label = "checksum_bad",
		severity = "warning",
		short = "checksum",
		meaning = "The command's checksum is neither 0 nor correct; no cFS app here checks it, so it is executed; of a transfer frame, a CFDP PDU or an own envelope, its CRC is wrong, and its receiver drops it.",
		unknowable = true,
	},
	{
		label = "checksum_absent",
		severity = "note",
		short = "",
		meaning = "The command's checksum is 0, as the EDORAS bridges send it; no cFS app here checks it.",
		unknowable = true,
	},
	{
		label = "sequence_unset",
		severity = "note",
		short = "",
		meaning = "The sequence word is 0x0000, as the EDORAS bridges send it, so a loss leaves no visible gap.",
	},
	{
		label = "envelope_overrun",
		severity = "error",
		short = "envelope overrun",
		meaning = "buffer_length exceeds the bytes in the packet, so there is no complete message; a receiver that trusts it reads beyond the data.",
		unknowable = true,
	},
	{
		label = "stale_tail",
		severity = "note",
		short = "",
		meaning = "The bytes after the CDR are not zero: a fixed-size struct still has them from an earlier, longer message; readers ignore them.",
	},
	{
		label = "cdr_invalid",
		severity = "error",
		short = "bad CDR",
		meaning = "The CDR body does not decode as the configured type; the receiver's rmw_deserialize fails on it.",
		unknowable = true,
	},
	{
		label = "unknown_msg_id",
		severity = "warning",
		short = "unknown MsgId",
		meaning = "No configured topic and no known cFE packet has this MsgId; without a subscriber the software bus drops it.",
	},
	{
		label = "sbn_size_mismatch",
		severity = "warning",
		short = "MsgSz",
		meaning = "MsgSz differs from the size of the payload; the receiver ignores that up to 32767 and refuses larger values.",
		unknowable = true,
	},
	{
		label = "sbn_unknown_type",
		severity = "error",
		short = "unknown SBN type",
		meaning = "MsgType is not an SBN message type; the receiver reports an error and drops the datagram.",
	},
	{
		label = "sbn_id_mismatch",
		severity = "error",
		short = "SBN identity",
		meaning = "Not a known peer: another $Id in SUB or UNSUB, or the SpacecraftID and ProcessorID of an unknown peer; the receiver refuses it.",
	},
	{
		label = "over_ci_buffer",
		severity = "error",
		short = "over 768",
		meaning = "The packet is longer than CI's 768-byte buffer, by its header too; CI cuts it to 768 and accepts it silently (cFS 7: drops it).",
	},
	{
		label = "over_bridge_buffer",
		severity = "warning",
		short = "over 1024",
		meaning = "The datagram is longer than the ground bridge's 1024-byte buffer; the bridge trusts buffer_length and publishes such a message as garbage.",
	},
	{
		label = "bridge_drops_length",
		severity = "warning",
		short = "length mod 256",
		meaning = "The length modulo 256 is below 11; the public flight bridge keeps the length in a uint8_t and drops the datagram.",
	},
	{
		label = "header_only",
		severity = "note",
		short = "",
		meaning = "The packet ends after its header: a scheduler's wake-up or a request, not a message.",
		unknowable = true,
	},
	{
		label = "invalid_msg_id",
		severity = "error",
		short = "invalid MsgId",
		meaning = "The MsgId is 0 or above 0x1FFF; the software bus refuses it (CFE_SB 21).",
	},
	{
		label = "wrong_direction",
		severity = "warning",
		short = "direction",
		meaning = "The MsgId's type bit is wrong for the link: telemetry sent to CI, or a command from TO; CI accepts it.",
	},
	{
		label = "unknown_function_code",
		severity = "error",
		short = "function code",
		meaning = "The app has no such function code; it sends an error event and ignores the command.",
	},
	{
		label = "command_length",
		severity = "error",
		short = "command length",
		meaning = "The command's length is wrong for its function code; apps refuse it with an event, except TO's enable command, which reads the bytes that exist.",
		unknowable = true,
	},
	{
		label = "over_software_bus",
		severity = "error",
		short = "over 32768",
		meaning = "The length field exceeds the software bus's 32768 bytes; the send fails (CFE_SB 15).",
	},
	{
		label = "sbn_version_mismatch",
		severity = "error",
		short = "SBN version",
		meaning = "PROTO has a protocol version other than 11; the receiver refuses it.",
	},
	{
		label = "sbn_no_message",
		severity = "note",
		short = "",
		meaning = "MsgType is NO_MSG; the receiver ignores it.",
	},
	{
		label = "sbn_legacy_header",
		severity = "warning",
		short = "7-byte header",
		meaning = "The SBN header has 7 bytes and no SpacecraftID, as in older versions; a current peer reads the next 4 bytes as one.",
		unknowable = true,
	},
	{
		label = "cdr_big_endian",
		severity = "note",
		short = "",
		meaning = "The CDR is big-endian, which no EDORAS sender on a little-endian machine writes; it is decoded nevertheless.",
	},
	{
		label = "fragment",
		severity = "note",
		short = "",
		meaning = "A part of a message: an IP fragment, a piece of a TCP stream, one of several WebSocket frames; the content comes with the frame that completes it, if one does.",
	},
	{
		label = "capture_cut",
		severity = "warning",
		short = "capture cut",
		meaning = "The capture's snap length cut the frame: bytes are missing in the capture, not on the wire.",
	},
	{
		label = "struct_length",
		severity = "warning",
		short = "struct length",
		meaning = "The payload has another length than the C struct known for this MsgId, so it is not decoded with it: another build; name its layout with --set structs.",
		unknowable = true,
	},
	{
		label = "cdr_trailing",
		severity = "note",
		short = "",
		meaning = "A few bytes follow the message's last field: rmw_serialize leaves them, mostly behind empty sequences; readers ignore them.",
		unknowable = true,
	},
	{
		label = "cdr_too_long",
		severity = "warning",
		short = "CDR too long",
		meaning = "More bytes follow the message's last field than ROS 2 leaves there; receivers ignore them, but often it is a message of another type.",
		unknowable = true,
	},
	{
		label = "stream_gap",
		severity = "warning",
		short = "stream gap",
		meaning = "Bytes of the stream before this (TCP segments, or transfer frames) are missing in the capture, or are no message of the link.",
	},
	{
		label = "stream_resent",
		severity = "note",
		short = "",
		meaning = "The TCP segment has bytes that had come before: they were lost on the way, or their acknowledgement was late.",
	},
}
D.links = {
	{
		label = "ci",
		code = 1,
		name = "CI",
		doc = "ground to cFS, one space packet a datagram (Command Ingest)",
		title = "CI link",
		to_cfs = true,
		from_cfs = false,
		packets = true,
		headers = {},
		header_bytes = 0,
		sure = 1,
		port_decides = true,
		sender_port = false,
		receive_buffer = 768,
		over_receive_buffer = "over_ci_buffer",
	},
	{
		label = "to",
		code = 2,
		name = "TO",
		doc = "cFS to ground, one space packet a datagram (Telemetry Output)",
		title = "TO link",
		to_cfs = false,
		from_cfs = true,
		packets = true,
		headers = {},
		header_bytes = 0,
		sure = 1,
		port_decides = true,
		sender_port = false,
		receive_buffer = 1024,
		over_receive_buffer = "over_bridge_buffer",
	},
	{
		label = "sbn",
		code = 3,
		name = "SBN",
		doc = "between Software Bus Network peers",
		title = "Software Bus Network",
		to_cfs = true,
		from_cfs = true,
		packets = true,
		headers = {"sbn", "sbn_sub", "sbn_proto"},
		header_bytes = 11,
		sure = 8,
		port_decides = true,
		sender_port = true,
	},
	{
		label = "robot",
		code = 4,
		name = "ROBOT",
		doc = "between a flight app and its robot, bare doubles over UDP",
		title = "ROBOT link",
		to_cfs = true,
		from_cfs = true,
		packets = false,
		values = true,
		headers = {"robot_command", "robot_pose", "robot_state"},
		header_bytes = 0,
		forms = {
			[48] = {headers = {"robot_command"}, port = 8585, doubles = 6},
			[56] = {headers = {"robot_pose"}, port = 8585, doubles = 7},
			[64] = {headers = {"robot_state"}, port = 8080, doubles = 7},
		},
		sure = 1,
		sender_port = false,
	},
	{
		label = "frames",
		code = 6,
		name = "FRAMES",
		doc = "CCSDS transfer frames (TM, AOS, TC), which carry the packets of another link",
		title = "FRAMES link",
		to_cfs = true,
		from_cfs = true,
		packets = false,
		headers = {"tm_frame", "aos_frame", "tc_frame", "tm_secondary", "aos_packets", "tc_segment"},
		header_bytes = 0,
		sure = 1,
		sender_port = false,
	},
	{
		label = "fprime",
		code = 7,
		name = "FPRIME",
		doc = "between F Prime and its ground data system (GDS), one frame a datagram",
		title = "FPRIME link",
		to_cfs = true,
		from_cfs = true,
		packets = false,
		headers = {
			"fprime",
			"fprime_tc",
			"fprime_tm",
			"fprime_space_packet",
			"fprime_packet",
			"fprime_command",
			"fprime_channel",
			"fprime_event",
			"fprime_file",
			"fprime_telemetry",
		},
		header_bytes = 0,
		sure = 1,
		sender_port = false,
	},
	{
		label = "racs2",
		code = 10,
		name = "RACS2",
		doc = "between the RACS2 bridges of ROS 2 and cFS, over WebSocket",
		title = "RACS2 link",
		to_cfs = true,
		from_cfs = true,
		packets = false,
		headers = {"racs2_topic", "racs2_message"},
		header_bytes = 0,
		sure = 1,
		sender_port = false,
	},
}
D.left = {[5111] = "cfdp", [5222] = "cfdp"}
D.sure = {by_content = 2, by_address = 4}
D.doubles = {smallest = 767, largest = 1086}
D.ports = {
	ci = {1234, 1235, 1236, 1237},
	to = {1235},
	sbn = {2234, 2235, 2236},
	robot = {8080, 8585},
	frames = {},
	fprime = {50000, 50001},
	racs2 = {},
}
D.stream_ports = {sbn = {2234, 2235, 2236}, fprime = {50000, 50001}, racs2 = {8765}}
D.frames = {}
D.frame_limits = {
	idle_apid = 2047,
	no_packet = 2047,
	only_idle = 2046,
	aos_idle = 63,
	ocf_bytes = 4,
	fecf_bytes = 2,
	first_part = 1,
	tc_bias = 1,
	late = 32,
}
D.dictionary = nil
D.of_links = {
	ci = {},
	to = {},
	sbn = {},
	robot = {},
	frames = {},
	fprime = {
		start_word = 3735928559,
		keep_alive = "sitting well",
		tm_bytes = 1024,
		time_bytes = 11,
		entry_headers = {
			[0] = "fprime_command",
			[1] = "fprime_channel",
			[2] = "fprime_event",
			[3] = "fprime_file",
			[4] = "fprime_telemetry",
		},
	},
	racs2 = {
		subprotocol = "example-protocol",
		largest = 128,
		values = {
			[1] = {name = "bool_data", kind = "bool"},
			[2] = {name = "float_data", kind = "float"},
			[3] = {name = "double_data", kind = "double"},
			[4] = {name = "int32_data", kind = "int64"},
			[5] = {name = "int64_data", kind = "int64"},
			[6] = {name = "string_data", kind = "string"},
			[7] = {name = "uint32_data", kind = "uint64"},
			[8] = {name = "uint64_data", kind = "uint64"},
			[9] = {name = "float32_array_data", kind = "float", array = true},
			[10] = {name = "float64_array_data", kind = "double", array = true},
			[11] = {name = "int32_array_data", kind = "int64", array = true},
			[12] = {name = "int64_array_data", kind = "int64", array = true},
			[13] = {name = "uint32_array_data", kind = "uint64", array = true},
			[14] = {name = "uint64_array_data", kind = "uint64", array = true},
		},
	},
}
D.bridge_ports = {2236}
D.cfs_addresses = {}
D.identities = {{66, 1}, {66, 3}}
D.routes = {
	{topic = "/cmd_vel", type = "geometry_msgs/msg/Twist", format = 1},
	{topic = "/telemetry_pose", type = "geometry_msgs/msg/PoseStamped", format = 1},
	{topic = "/command_pose", type = "geometry_msgs/msg/Pose", format = 1},
	{topic = "/telemetry_joint_state", type = "sensor_msgs/msg/JointState", format = 1},
	{topic = "/robot_1/ground/cmd_vel", type = "geometry_msgs/msg/Twist", format = 1},
	{topic = "/robot_2/ground/cmd_vel", type = "geometry_msgs/msg/Twist", format = 1},
	{topic = "/robot_1/ground/pose", type = "geometry_msgs/msg/PoseStamped", format = 1},
	{topic = "/robot_2/ground/pose", type = "geometry_msgs/msg/PoseStamped", format = 1},
	{topic = "/robot_1/pose", type = "geometry_msgs/msg/PoseStamped", format = 1},
	{topic = "/robot_2/pose", type = "geometry_msgs/msg/PoseStamped", format = 1},
	{topic = "/robot_1/cmd_vel", type = "geometry_msgs/msg/Twist", format = 1},
	{topic = "/robot_2/cmd_vel", type = "geometry_msgs/msg/Twist", format = 1},
	{topic = "/big_arm/ground/target", type = "geometry_msgs/msg/Pose", format = 1},
	{topic = "/little_arm/ground/target", type = "geometry_msgs/msg/Pose", format = 1},
	{topic = "/big_arm/ground/joint_states", type = "sensor_msgs/msg/JointState", format = 1},
	{topic = "/little_arm/ground/joint_states", type = "sensor_msgs/msg/JointState", format = 1},
	{topic = "/big_arm/joint_states_throttled", type = "sensor_msgs/msg/JointState", format = 1},
	{topic = "/little_arm/joint_states_throttled", type = "sensor_msgs/msg/JointState", format = 1},
	{topic = "/big_arm/flight/target_pose", type = "geometry_msgs/msg/Pose", format = 1},
	{topic = "/little_arm/flight/target_pose", type = "geometry_msgs/msg/Pose", format = 1},
}
D.exact = {
	ci = {[6183] = {1, 3, 5, 13}, [6184] = {6, 14}},
	to = {[2087] = {2, 4}, [2088] = {7, 15}, [2089] = {8, 16}},
	sbn = {[2090] = {11, 19}, [2091] = {12, 20}, [6185] = {9, 17}, [6186] = {10, 18}},
}
D.any_link = {
	[2087] = {2, 4},
	[2088] = {7, 15},
	[2089] = {8, 16},
	[2090] = {11, 19},
	[2091] = {12, 20},
	[6183] = {1, 3, 5, 13},
	[6184] = {6, 14},
	[6185] = {9, 17},
	[6186] = {10, 18},
}
D.types = {
	["geometry_msgs/msg/Twist"] = {
		fixed = 48,
		trailing = 7,
		steps = {
			{
				alignment = 8,
				size = 48,
				leaves = {
					{name = "linear.x", code = "d", size = 8, offset = 0},
					{name = "linear.y", code = "d", size = 8, offset = 8},
					{name = "linear.z", code = "d", size = 8, offset = 16},
					{name = "angular.x", code = "d", size = 8, offset = 24},
					{name = "angular.y", code = "d", size = 8, offset = 32},
					{name = "angular.z", code = "d", size = 8, offset = 40},
				},
			},
		},
	},
	["geometry_msgs/msg/PoseStamped"] = {
		trailing = 7,
		steps = {
			{
				alignment = 4,
				size = 8,
				leaves = {
					{name = "header.stamp.sec", code = "i", size = 4, offset = 0},
					{name = "header.stamp.nanosec", code = "I", size = 4, offset = 4},
				},
			},
			{name = "header.frame_id", bound = 0, width = 1},
			{
				alignment = 8,
				size = 56,
				leaves = {
					{name = "pose.position.x", code = "d", size = 8, offset = 0},
					{name = "pose.position.y", code = "d", size = 8, offset = 8},
					{name = "pose.position.z", code = "d", size = 8, offset = 16},
					{name = "pose.orientation.x", code = "d", size = 8, offset = 24},
					{name = "pose.orientation.y", code = "d", size = 8, offset = 32},
					{name = "pose.orientation.z", code = "d", size = 8, offset = 40},
					{name = "pose.orientation.w", code = "d", size = 8, offset = 48},
				},
			},
		},
	},
	["geometry_msgs/msg/Pose"] = {
		fixed = 56,
		trailing = 7,
		steps = {
			{
				alignment = 8,
				size = 56,
				leaves = {
					{name = "position.x", code = "d", size = 8, offset = 0},
					{name = "position.y", code = "d", size = 8, offset = 8},
					{name = "position.z", code = "d", size = 8, offset = 16},
					{name = "orientation.x", code = "d", size = 8, offset = 24},
					{name = "orientation.y", code = "d", size = 8, offset = 32},
					{name = "orientation.z", code = "d", size = 8, offset = 40},
					{name = "orientation.w", code = "d", size = 8, offset = 48},
				},
			},
		},
	},
	["sensor_msgs/msg/JointState"] = {
		trailing = 19,
		steps = {
			{
				alignment = 4,
				size = 8,
				leaves = {
					{name = "header.stamp.sec", code = "i", size = 4, offset = 0},
					{name = "header.stamp.nanosec", code = "I", size = 4, offset = 4},
				},
			},
			{name = "header.frame_id", bound = 0, width = 1},
			{
				name = "name",
				bound = 0,
				least = 4,
				unnamed = true,
				steps = {{name = "", bound = 0, width = 1}},
			},
			{
				name = "position",
				bound = 0,
				least = 8,
				element = true,
				uniform = {alignment = 8, size = 8},
				unnamed = true,
				steps = {
					{
						alignment = 8,
						size = 8,
						leaves = {{name = "", code = "d", size = 8, offset = 0}},
					},
				},
			},
			{
				name = "velocity",
				bound = 0,
				least = 8,
				element = true,
				uniform = {alignment = 8, size = 8},
				unnamed = true,
				steps = {
					{
						alignment = 8,
						size = 8,
						leaves = {{name = "", code = "d", size = 8, offset = 0}},
					},
				},
			},
			{
				name = "effort",
				bound = 0,
				least = 8,
				element = true,
				uniform = {alignment = 8, size = 8},
				unnamed = true,
				steps = {
					{
						alignment = 8,
						size = 8,
						leaves = {{name = "", code = "d", size = 8, offset = 0}},
					},
				},
			},
		},
	},
}
D.extended_header = false
D.telemetry_header = 16
D.msg_id_version = 1
D.time = {ticks = 65536}

local byte = string.byte
D.read = {}

function D.read.sbn(s, p)
	local b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10 = byte(s, p + 0, p + 10)
	local msg_size = b0 * 256 + b1
	if msg_size >= 32768 then msg_size = msg_size - 65536 end
	local msg_type = b2
	local processor_id = ((b3 * 256 + b4) * 256 + b5) * 256 + b6
	local spacecraft_id = ((b7 * 256 + b8) * 256 + b9) * 256 + b10
	return msg_size, msg_type, processor_id, spacecraft_id
end

function D.read.sbn_sub(s, p)
	local b48, b49 = byte(s, p + 48, p + 49)
	local count = b48 * 256 + b49
	local ident = D.text(s, p + 0, p + 47)
	return count, ident
end

function D.read.sbn_proto(s, p)
	local b0 = byte(s, p + 0, p + 0)
	local protocol_version = b0
	return protocol_version
end

function D.read.robot_command(s, p)
	return 
end

function D.read.robot_pose(s, p)
	return 
end

function D.read.robot_state(s, p)
	local b56, b57, b58, b59, b60, b61, b62, b63 = byte(s, p + 56, p + 63)
	local stamp_seconds = ((b59 * 256 + b58) * 256 + b57) * 256 + b56
	if stamp_seconds >= 2147483648 then stamp_seconds = stamp_seconds - 4294967296 end
	local stamp_nanoseconds = ((b63 * 256 + b62) * 256 + b61) * 256 + b60
	return stamp_seconds, stamp_nanoseconds
end

function D.read.tm_frame(s, p)
	local b0, b1, b2, b3, b4, b5 = byte(s, p + 0, p + 5)
	local transfer_frame_version_number = b0
	transfer_frame_version_number = (transfer_frame_version_number - transfer_frame_version_number % 64) / 64
	local spacecraft_id = b0 * 256 + b1
	spacecraft_id = (spacecraft_id - spacecraft_id % 16) / 16
	spacecraft_id = spacecraft_id % 1024
	local virtual_channel_id = b1
	virtual_channel_id = (virtual_channel_id - virtual_channel_id % 2) / 2
	virtual_channel_id = virtual_channel_id % 8
	local ocf_flag = b1
	ocf_flag = ocf_flag % 2
	local master_channel_frame_count = b2
	local virtual_channel_frame_count = b3
	local secondary_header_flag = b4
	secondary_header_flag = (secondary_header_flag - secondary_header_flag % 128) / 128
	local synchronization_flag = b4
	synchronization_flag = (synchronization_flag - synchronization_flag % 64) / 64
	synchronization_flag = synchronization_flag % 2
	local packet_order_flag = b4
	packet_order_flag = (packet_order_flag - packet_order_flag % 32) / 32
	packet_order_flag = packet_order_flag % 2
	local segment_length_id = b4
	segment_length_id = (segment_length_id - segment_length_id % 8) / 8
	segment_length_id = segment_length_id % 4
	local first_header_pointer = b4 * 256 + b5
	first_header_pointer = first_header_pointer % 2048
	return transfer_frame_version_number, spacecraft_id, virtual_channel_id, ocf_flag, master_channel_frame_count, virtual_channel_frame_count, secondary_header_flag, synchronization_flag, packet_order_flag, segment_length_id, first_header_pointer
end

function D.read.aos_frame(s, p)
	local b0, b1, b2, b3, b4, b5 = byte(s, p + 0, p + 5)
	local transfer_frame_version_number = b0
	transfer_frame_version_number = (transfer_frame_version_number - transfer_frame_version_number % 64) / 64
	local spacecraft_id = b0 * 256 + b1
	spacecraft_id = (spacecraft_id - spacecraft_id % 64) / 64
	spacecraft_id = spacecraft_id % 256
	local virtual_channel_id = b1
	virtual_channel_id = virtual_channel_id % 64
	local virtual_channel_frame_count = (b2 * 256 + b3) * 256 + b4
	local replay_flag = b5
	replay_flag = (replay_flag - replay_flag % 128) / 128
	local frame_count_usage_flag = b5
	frame_count_usage_flag = (frame_count_usage_flag - frame_count_usage_flag % 64) / 64
	frame_count_usage_flag = frame_count_usage_flag % 2
	local spacecraft_id_high = b5
	spacecraft_id_high = (spacecraft_id_high - spacecraft_id_high % 16) / 16
	spacecraft_id_high = spacecraft_id_high % 4
	local frame_count_cycle = b5
	frame_count_cycle = frame_count_cycle % 16
	return transfer_frame_version_number, spacecraft_id, virtual_channel_id, virtual_channel_frame_count, replay_flag, frame_count_usage_flag, spacecraft_id_high, frame_count_cycle
end

function D.read.tc_frame(s, p)
	local b0, b1, b2, b3, b4 = byte(s, p + 0, p + 4)
	local transfer_frame_version_number = b0
	transfer_frame_version_number = (transfer_frame_version_number - transfer_frame_version_number % 64) / 64
	local bypass_flag = b0
	bypass_flag = (bypass_flag - bypass_flag % 32) / 32
	bypass_flag = bypass_flag % 2
	local control_command_flag = b0
	control_command_flag = (control_command_flag - control_command_flag % 16) / 16
	control_command_flag = control_command_flag % 2
	local reserved = b0
	reserved = (reserved - reserved % 4) / 4
	reserved = reserved % 4
	local spacecraft_id = b0 * 256 + b1
	spacecraft_id = spacecraft_id % 1024
	local virtual_channel_id = b2
	virtual_channel_id = (virtual_channel_id - virtual_channel_id % 4) / 4
	local frame_length = b2 * 256 + b3
	frame_length = frame_length % 1024
	local frame_sequence_number = b4
	return transfer_frame_version_number, bypass_flag, control_command_flag, reserved, spacecraft_id, virtual_channel_id, frame_length, frame_sequence_number
end

function D.read.tm_secondary(s, p)
	local b0 = byte(s, p + 0, p + 0)
	local version_number = b0
	version_number = (version_number - version_number % 64) / 64
	local secondary_header_length = b0
	secondary_header_length = secondary_header_length % 64
	return version_number, secondary_header_length
end

function D.read.aos_packets(s, p)
	local b0, b1 = byte(s, p + 0, p + 1)
	local reserved = b0
	reserved = (reserved - reserved % 8) / 8
	local first_header_pointer = b0 * 256 + b1
	first_header_pointer = first_header_pointer % 2048
	return reserved, first_header_pointer
end

function D.read.tc_segment(s, p)
	local b0 = byte(s, p + 0, p + 0)
	local segment_sequence_flags = b0
	segment_sequence_flags = (segment_sequence_flags - segment_sequence_flags % 64) / 64
	local map_id = b0
	map_id = map_id % 64
	return segment_sequence_flags, map_id
end

function D.read.fprime(s, p)
	local b0, b1, b2, b3, b4, b5, b6, b7 = byte(s, p + 0, p + 7)
	local start_word = ((b0 * 256 + b1) * 256 + b2) * 256 + b3
	local length = ((b4 * 256 + b5) * 256 + b6) * 256 + b7
	return start_word, length
end

function D.read.fprime_tc(s, p)
	local b0, b1, b2, b3, b4 = byte(s, p + 0, p + 4)
	local transfer_frame_version_number = b0
	transfer_frame_version_number = (transfer_frame_version_number - transfer_frame_version_number % 64) / 64
	local bypass_flag = b0
	bypass_flag = (bypass_flag - bypass_flag % 32) / 32
	bypass_flag = bypass_flag % 2
	local control_command_flag = b0
	control_command_flag = (control_command_flag - control_command_flag % 16) / 16
	control_command_flag = control_command_flag % 2
	local reserved = b0
	reserved = (reserved - reserved % 4) / 4
	reserved = reserved % 4
	local spacecraft_id = b0 * 256 + b1
	spacecraft_id = spacecraft_id % 1024
	local virtual_channel_id = b2
	virtual_channel_id = (virtual_channel_id - virtual_channel_id % 4) / 4
	local frame_length = b2 * 256 + b3
	frame_length = frame_length % 1024
	local frame_sequence_number = b4
	return transfer_frame_version_number, bypass_flag, control_command_flag, reserved, spacecraft_id, virtual_channel_id, frame_length, frame_sequence_number
end

function D.read.fprime_tm(s, p)
	local b0, b1, b2, b3, b4, b5 = byte(s, p + 0, p + 5)
	local transfer_frame_version_number = b0
	transfer_frame_version_number = (transfer_frame_version_number - transfer_frame_version_number % 64) / 64
	local spacecraft_id = b0 * 256 + b1
	spacecraft_id = (spacecraft_id - spacecraft_id % 16) / 16
	spacecraft_id = spacecraft_id % 1024
	local virtual_channel_id = b1
	virtual_channel_id = (virtual_channel_id - virtual_channel_id % 2) / 2
	virtual_channel_id = virtual_channel_id % 8
	local ocf_flag = b1
	ocf_flag = ocf_flag % 2
	local master_channel_frame_count = b2
	local virtual_channel_frame_count = b3
	local secondary_header_flag = b4
	secondary_header_flag = (secondary_header_flag - secondary_header_flag % 128) / 128
	local synchronization_flag = b4
	synchronization_flag = (synchronization_flag - synchronization_flag % 64) / 64
	synchronization_flag = synchronization_flag % 2
	local packet_order_flag = b4
	packet_order_flag = (packet_order_flag - packet_order_flag % 32) / 32
	packet_order_flag = packet_order_flag % 2
	local segment_length_id = b4
	segment_length_id = (segment_length_id - segment_length_id % 8) / 8
	segment_length_id = segment_length_id % 4
	local first_header_pointer = b4 * 256 + b5
	first_header_pointer = first_header_pointer % 2048
	return transfer_frame_version_number, spacecraft_id, virtual_channel_id, ocf_flag, master_channel_frame_count, virtual_channel_frame_count, secondary_header_flag, synchronization_flag, packet_order_flag, segment_length_id, first_header_pointer
end

function D.read.fprime_space_packet(s, p)
	local b0, b1, b2, b3, b4, b5 = byte(s, p + 0, p + 5)
	local packet_version_number = b0
	packet_version_number = (packet_version_number - packet_version_number % 32) / 32
	local packet_type = b0
	packet_type = (packet_type - packet_type % 16) / 16
	packet_type = packet_type % 2
	local secondary_header_flag = b0
	secondary_header_flag = (secondary_header_flag - secondary_header_flag % 8) / 8
	secondary_header_flag = secondary_header_flag % 2
	local apid = b0 * 256 + b1
	apid = apid % 2048
	local sequence_flags = b2
	sequence_flags = (sequence_flags - sequence_flags % 64) / 64
	local packet_sequence_count = b2 * 256 + b3
	packet_sequence_count = packet_sequence_count % 16384
	local packet_data_length = b4 * 256 + b5
	return packet_version_number, packet_type, secondary_header_flag, apid, sequence_flags, packet_sequence_count, packet_data_length
end

function D.read.fprime_packet(s, p)
	local b0, b1 = byte(s, p + 0, p + 1)
	local packet_type = b0 * 256 + b1
	return packet_type
end

function D.read.fprime_command(s, p)
	local b0, b1, b2, b3 = byte(s, p + 0, p + 3)
	local opcode = ((b0 * 256 + b1) * 256 + b2) * 256 + b3
	return opcode
end

function D.read.fprime_channel(s, p)
	local b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14 = byte(s, p + 0, p + 14)
	local channel_id = ((b0 * 256 + b1) * 256 + b2) * 256 + b3
	local time_base = b4 * 256 + b5
	local time_context = b6
	local seconds = ((b7 * 256 + b8) * 256 + b9) * 256 + b10
	local microseconds = ((b11 * 256 + b12) * 256 + b13) * 256 + b14
	return channel_id, time_base, time_context, seconds, microseconds
end

function D.read.fprime_event(s, p)
	local b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14 = byte(s, p + 0, p + 14)
	local event_id = ((b0 * 256 + b1) * 256 + b2) * 256 + b3
	local time_base = b4 * 256 + b5
	local time_context = b6
	local seconds = ((b7 * 256 + b8) * 256 + b9) * 256 + b10
	local microseconds = ((b11 * 256 + b12) * 256 + b13) * 256 + b14
	return event_id, time_base, time_context, seconds, microseconds
end

function D.read.fprime_file(s, p)
	local b0, b1, b2, b3, b4 = byte(s, p + 0, p + 4)
	local kind = b0
	local sequence_index = ((b1 * 256 + b2) * 256 + b3) * 256 + b4
	return kind, sequence_index
end

function D.read.fprime_telemetry(s, p)
	local b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12 = byte(s, p + 0, p + 12)
	local packet_id = b0 * 256 + b1
	local time_base = b2 * 256 + b3
	local time_context = b4
	local seconds = ((b5 * 256 + b6) * 256 + b7) * 256 + b8
	local microseconds = ((b9 * 256 + b10) * 256 + b11) * 256 + b12
	return packet_id, time_base, time_context, seconds, microseconds
end

function D.read.racs2_topic(s, p)
	local topic_name = D.text(s, p + 0, p + 31)
	return topic_name
end

function D.read.racs2_message(s, p)
	local b0, b1 = byte(s, p + 0, p + 1)
	local msg_id = b0 * 256 + b1
	return msg_id
end

function D.read.ccsds(s, p)
	local b0, b1, b2, b3, b4, b5 = byte(s, p + 0, p + 5)
	local packet_version_number = b0
	packet_version_number = (packet_version_number - packet_version_number % 32) / 32
	local packet_type = b0
	packet_type = (packet_type - packet_type % 16) / 16
	packet_type = packet_type % 2
	local secondary_header_flag = b0
	secondary_header_flag = (secondary_header_flag - secondary_header_flag % 8) / 8
	secondary_header_flag = secondary_header_flag % 2
	local apid = b0 * 256 + b1
	apid = apid % 2048
	local sequence_flags = b2
	sequence_flags = (sequence_flags - sequence_flags % 64) / 64
	local packet_sequence_count = b2 * 256 + b3
	packet_sequence_count = packet_sequence_count % 16384
	local packet_data_length = b4 * 256 + b5
	return packet_version_number, packet_type, secondary_header_flag, apid, sequence_flags, packet_sequence_count, packet_data_length
end

function D.read.extended(s, p)
	local b0, b1, b2, b3 = byte(s, p + 0, p + 3)
	local eds_version = b0
	eds_version = (eds_version - eds_version % 8) / 8
	local endian = b0
	endian = (endian - endian % 4) / 4
	endian = endian % 2
	local playback = b0
	playback = (playback - playback % 2) / 2
	playback = playback % 2
	local subsystem_id = b0 * 256 + b1
	subsystem_id = subsystem_id % 512
	local system_id = b2 * 256 + b3
	return eds_version, endian, playback, subsystem_id, system_id
end

function D.read.command(s, p)
	local b0, b1 = byte(s, p + 0, p + 1)
	local reserved = b0
	reserved = (reserved - reserved % 128) / 128
	local function_code = b0
	function_code = function_code % 128
	local checksum = b1
	return reserved, function_code, checksum
end

function D.read.command_extended(s, p)
	local b0, b1 = byte(s, p + 0, p + 1)
	local reserved = b0
	reserved = (reserved - reserved % 128) / 128
	local function_code = b0
	function_code = function_code % 128
	local checksum = b1
	return reserved, function_code, checksum
end

function D.read.telemetry(s, p)
	local b0, b1, b2, b3, b4, b5 = byte(s, p + 0, p + 5)
	local seconds = ((b0 * 256 + b1) * 256 + b2) * 256 + b3
	local subseconds = b4 * 256 + b5
	return seconds, subseconds
end

function D.read.telemetry_short(s, p)
	local b0, b1, b2, b3, b4, b5 = byte(s, p + 0, p + 5)
	local seconds = ((b0 * 256 + b1) * 256 + b2) * 256 + b3
	local subseconds = b4 * 256 + b5
	return seconds, subseconds
end

function D.read.telemetry_extended(s, p)
	local b0, b1, b2, b3, b4, b5 = byte(s, p + 0, p + 5)
	local seconds = ((b0 * 256 + b1) * 256 + b2) * 256 + b3
	local subseconds = b4 * 256 + b5
	return seconds, subseconds
end

function D.read.event(s, p)
	local b20, b21, b22, b23, b24, b25, b26, b27, b28, b29, b30, b31 = byte(s, p + 20, p + 31)
	local event_id = b21 * 256 + b20
	local event_type = b23 * 256 + b22
	local spacecraft_id = ((b27 * 256 + b26) * 256 + b25) * 256 + b24
	local processor_id = ((b31 * 256 + b30) * 256 + b29) * 256 + b28
	local app_name = D.text(s, p + 0, p + 19)
	local message = D.text(s, p + 32, p + 153)
	return event_id, event_type, spacecraft_id, processor_id, app_name, message
end

function D.read.software_bus(s, p)
	local b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14, b15, b16, b17, b18, b19, b20, b21, b22, b23, b24, b25, b26, b27 = byte(s, p + 0, p + 27)
	local command_counter = b0
	local command_error_counter = b1
	local no_subscribers_counter = b2
	local message_send_error_counter = b3
	local message_receive_error_counter = b4
	local internal_error_counter = b5
	local create_pipe_error_counter = b6
	local subscribe_error_counter = b7
	local pipe_options_error_counter = b8
	local duplicate_subscriptions_counter = b9
	local get_pipe_id_by_name_error_counter = b10
	local spare = b11
	local pipe_overflow_error_counter = b13 * 256 + b12
	local message_limit_error_counter = b15 * 256 + b14
	local memory_pool_handle = ((b19 * 256 + b18) * 256 + b17) * 256 + b16
	local memory_in_use = ((b23 * 256 + b22) * 256 + b21) * 256 + b20
	local unmarked_memory = ((b27 * 256 + b26) * 256 + b25) * 256 + b24
	return command_counter, command_error_counter, no_subscribers_counter, message_send_error_counter, message_receive_error_counter, internal_error_counter, create_pipe_error_counter, subscribe_error_counter, pipe_options_error_counter, duplicate_subscriptions_counter, get_pipe_id_by_name_error_counter, spare, pipe_overflow_error_counter, message_limit_error_counter, memory_pool_handle, memory_in_use, unmarked_memory
end

function D.read.sbn_legacy(s, p)
	local b0, b1, b2, b3, b4, b5, b6 = byte(s, p + 0, p + 6)
	local msg_size = b0 * 256 + b1
	if msg_size >= 32768 then msg_size = msg_size - 65536 end
	local msg_type = b2
	local processor_id = ((b3 * 256 + b4) * 256 + b5) * 256 + b6
	return msg_size, msg_type, processor_id
end

function D.read.subscription(s, p)
	local b0, b1, b2, b3, b4, b5 = byte(s, p + 0, p + 5)
	local msg_id = ((b0 * 256 + b1) * 256 + b2) * 256 + b3
	local priority = b4
	local reliability = b5
	return msg_id, priority, reliability
end

function D.read.cdr(s, p)
	local b0, b1, b2, b3 = byte(s, p + 0, p + 3)
	local representation = b0 * 256 + b1
	local options = b2 * 256 + b3
	return representation, options
end

function D.read.envelope_1(s, p)
	local b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14, b15 = byte(s, p + 0, p + 15)
	local buffer_length = ((((((b7 * 256.0 + b6) * 256.0 + b5) * 256.0 + b4) * 256.0 + b3) * 256.0 + b2) * 256.0 + b1) * 256.0 + b0
	local buffer_capacity = ((((((b15 * 256.0 + b14) * 256.0 + b13) * 256.0 + b12) * 256.0 + b11) * 256.0 + b10) * 256.0 + b9) * 256.0 + b8
	return buffer_length, buffer_capacity
end

function D.read.envelope_2(s, p)
	local b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14, b15 = byte(s, p + 0, p + 15)
	local buffer_length = ((((((b0 * 256.0 + b1) * 256.0 + b2) * 256.0 + b3) * 256.0 + b4) * 256.0 + b5) * 256.0 + b6) * 256.0 + b7
	local buffer_capacity = ((((((b8 * 256.0 + b9) * 256.0 + b10) * 256.0 + b11) * 256.0 + b12) * 256.0 + b13) * 256.0 + b14) * 256.0 + b15
	return buffer_length, buffer_capacity
end

function D.read.envelope_3(s, p)
	local b0, b1, b2, b3, b4, b5, b6, b7 = byte(s, p + 0, p + 7)
	local buffer_length = ((b3 * 256 + b2) * 256 + b1) * 256 + b0
	local buffer_capacity = ((b7 * 256 + b6) * 256 + b5) * 256 + b4
	return buffer_length, buffer_capacity
end

function D.read.envelope_4(s, p)
	local b0, b1, b2, b3, b4, b5, b6, b7 = byte(s, p + 0, p + 7)
	local buffer_length = ((b0 * 256 + b1) * 256 + b2) * 256 + b3
	local buffer_capacity = ((b4 * 256 + b5) * 256 + b6) * 256 + b7
	return buffer_length, buffer_capacity
end

function D.read.envelope_5(s, p)
	local b0, b1, b2, b3 = byte(s, p + 0, p + 3)
	local buffer_length = b1 * 256 + b0
	local buffer_capacity = b3 * 256 + b2
	return buffer_length, buffer_capacity
end

function D.read.envelope_6(s, p)
	local b0, b1, b2, b3 = byte(s, p + 0, p + 3)
	local buffer_length = b0 * 256 + b1
	local buffer_capacity = b2 * 256 + b3
	return buffer_length, buffer_capacity
end

function D.read.envelope_7(s, p)
	local b0, b1 = byte(s, p + 0, p + 1)
	local buffer_length = b0
	local buffer_capacity = b1
	return buffer_length, buffer_capacity
end

-- Small tools that all parts share.

local bit = bit
local unpack, format = Struct.unpack, string.format
local analysis = {}  -- what the sequence count says of a frame: a gap's size, "duplicate" or "reordered"

-- A text field, cut at its first NUL.
function D.text(s, first, last)
	local stop = s:find("\0", first, true)
	return s:sub(first, (stop and stop <= last) and stop - 1 or last)
end

local FOLLOWING = {}  -- first byte of a UTF-8 character: how many follow, and which the second may be
for octet = 0xC2, 0xDF do FOLLOWING[octet] = {1, 0x80, 0xBF} end
for octet = 0xE0, 0xEF do FOLLOWING[octet] = {2, 0x80, 0xBF} end
for octet = 0xF0, 0xF4 do FOLLOWING[octet] = {3, 0x80, 0xBF} end
FOLLOWING[0xE0][2], FOLLOWING[0xED][3] = 0xA0, 0x9F
FOLLOWING[0xF0][2], FOLLOWING[0xF4][3] = 0x90, 0x8F

-- Text as UTF-8, its mistakes replaced (Unicode 3.9: one U+FFFD for each maximal part).
local function utf8_text(s)
	if not s:find("[\128-\255]") then
		return s
	end
	local out, p = {}, 1
	while p <= #s do
		local first = s:byte(p)
		local rule, q = FOLLOWING[first], p + 1
		local whole = first < 0x80 or rule ~= nil
		for index = 1, rule and rule[1] or 0 do
			local next_byte = s:byte(q)
			local low, high = 0x80, 0xBF
			if index == 1 then low, high = rule[2], rule[3] end
			if not next_byte or next_byte < low or next_byte > high then
				whole = false
				break
			end
			q = q + 1
		end
		out[#out + 1] = whole and s:sub(p, q - 1) or "\239\191\189"
		p = q
	end
	return table.concat(out)
end

-- A Unicode scalar as UTF-8.
local function utf8_character(code)
	if code < 0x80 then
		return string.char(code)
	elseif code < 0x800 then
		return string.char(0xC0 + math.floor(code / 64), 0x80 + code % 64)
	elseif code < 0x10000 then
		return string.char(0xE0 + math.floor(code / 4096), 0x80 + math.floor(code / 64) % 64, 0x80 + code % 64)
	end
	return string.char(
		0xF0 + math.floor(code / 262144), 0x80 + math.floor(code / 4096) % 64,
		0x80 + math.floor(code / 64) % 64, 0x80 + code % 64
	)
end

-- A wide string: UTF-16 units of some bytes each; half a surrogate pair is replaced.
local function wide_text(s, first, last, width, big)
	local out, p = {}, first
	local code = (big and ">I" or "<I") .. string.format("%d", width)
	while p <= last do
		local unit = unpack(code, s, p) % 65536
		p = p + width
		if unit >= 0xD800 and unit < 0xDC00 and p <= last then
			local low = unpack(code, s, p) % 65536
			if low >= 0xDC00 and low < 0xE000 then
				p = p + width
				unit = 0x10000 + (unit - 0xD800) * 1024 + low - 0xDC00
			else
				unit = 0xFFFD
			end
		elseif unit >= 0xD800 and unit < 0xE000 then
			unit = 0xFFFD
		end
		out[#out + 1] = utf8_character(unit)
	end
	return table.concat(out)
end

local FOLD = {}  -- a format for each number of words
for words = 1, 64 do FOLD[words] = "<" .. string.rep("I4", words) end

-- cFE's checksum, 0 for a packet that is right: 0xFF XOR every byte. XOR is blind to order, so words fold first.
local function checksum(s, first, last)
	local word, p = 0, first
	while last - p >= 3 do
		local words = math.min(64, math.floor((last - p + 1) / 4))
		-- The last value is where the reading ended: it is told to cancel itself out.
		local stop = p + 4 * words
		word = bit.bxor(word, stop, unpack(FOLD[words], s, p))
		p = stop
	end
	if p <= last then
		word = bit.bxor(word, s:byte(p, last))
	end
	word = bit.bxor(word, bit.rshift(word, 16))
	return bit.band(bit.bxor(word, bit.rshift(word, 8), 0xFF), 0xFF)
end

-- The steps of the CRCs by byte: CRC-16 of CCSDS, and CRC-32 of IEEE 802.3.
local CRC16, CRC32 = {}, {}
for octet = 0, 255 do
	local left, right = octet * 256, octet
	for _ = 1, 8 do
		left = left >= 0x8000 and bit.bxor(left * 2 % 0x10000, 0x1021) or left * 2
		right = right % 2 == 1 and bit.bxor((right - 1) / 2, 0xEDB88320) % 0x100000000 or right / 2
	end
	CRC16[octet], CRC32[octet] = left, right
end

local function crc16(s, first, last)
	local crc, xor, byte = 0xFFFF, bit.bxor, string.byte
	for p = first, last do
		local low = crc % 256
		crc = xor(low * 256, CRC16[xor((crc - low) / 256, byte(s, p))])
	end
	return crc
end

local function crc32(s, first, last)
	local crc, xor, shift, byte = 0xFFFFFFFF, bit.bxor, bit.rshift, string.byte
	for p = first, last do
		crc = xor(shift(crc, 8), CRC32[xor(crc % 256, byte(s, p))])
	end
	return xor(crc, 0xFFFFFFFF) % 0x100000000
end

-- A line has no line ends; a format would end at a NUL.
local function printable(text)
	return text:find("%c") and text:gsub("%c", " ") or text
end

-- Tell whether any byte of a stretch is not 0.
local function any_nonzero(s, first, last)
	local found = first <= last and s:find("[^\0]", first)
	return found and found <= last or false
end

-- A set of port numbers from "1234-1237,2000".
local function port_set(text)
	local set = {}
	for part in tostring(text):gmatch("[^,%s]+") do
		local low, high = part:match("^(%d+)%-(%d+)$")
		low, high = tonumber(low or part), tonumber(high or part)
		for port = low or 1, high or 0 do set[port] = true end
	end
	return set
end

-- What Wireshark shows: the protocols, a field for every slot of every layout, and the expert information.

-- Looked up once: tree:add() and the like search for the method in every call.
local add, add_le, cut = TreeItem.add, TreeItem.add_le, Tvb.range
local set_text, set_generated, add_expert = TreeItem.set_text, TreeItem.set_generated, TreeItem.add_proto_expert_info

local TITLES = {
	ccsds_sp = "CCSDS Space Packet", cfe = "core Flight System", ros2cdr = "ROS 2 message (CDR)",
}
for _, link in ipairs(D.links) do
	if #link.headers > 0 then TITLES[link.label] = link.title end
end
local P = {edoras = EDORAS}
local members = {edoras = {}}
for name, title in pairs(TITLES) do
	local made, proto = pcall(Proto, name, title)
	if not made then proto = Proto("edoras_" .. name, title) end  -- Wireshark knows a protocol of that name
	P[name], members[name] = proto, {}
end
local by_name = {}  -- abbreviation to record

-- Make a field, or find the one of that name. A record's `on` tells whether anybody asks for it, where there
-- is no tree for people.
local function new_field(protocol, abbreviation, kind, ...)
	local record = by_name[abbreviation]
	if not record then
		local made = ProtoField[kind](abbreviation, ...)
		record = {field = made, protocol = protocol, on = false}
		by_name[abbreviation] = record
		table.insert(members[protocol], made)
		table.insert(members, record)
	end
	return record
end

-- Tell what a special value of a field means.
local function mark(item, value, names)
	if names[value] then item:append_text(" (" .. names[value] .. ")") end
end

-- Make a function that adds some slots of a layout, without a loop: (node, tvb, offset, the datagram's bytes).
local function adder(layout, slots)
	local text = {"local add, put, turn, cut, text, mark, fields, names = ...", "", "return function(node, tvb, at, s)", "local range"}
	local fields, names, before = {}, {}, {}
	for index, slot in ipairs(slots) do
		fields[index], names[index] = slot.record.field, slot.names
		text[2] = text[2] .. format("\nlocal field%d = fields[%d]", index, index)
		if slot.start ~= before.start or slot.size ~= before.size then
			text[#text + 1] = format("range = cut(tvb, at + %d, %d)", slot.start, slot.size)
		end
		if slot.kind == "string" then
			text[#text + 1] = format(
				"add(node, field%d, range, text(s, at + %d, at + %d))", index, slot.start + 1, slot.start + slot.size
			)
		elseif slot.special then
			text[#text + 1] = format(
				"mark(%s(node, field%d, range), range:bitfield(%d, %d), names[%d])", slot.turned and "turn" or "put",
				index, slot.special[1], slot.special[2], index
			)
		else
			text[#text + 1] = format("%s(node, field%d, range)", slot.turned and "turn" or "put", index)
		end
		before = slot
	end
	text[#text + 1] = "end"
	local function readable(...) return utf8_text(D.text(...)) end
	local put, turn = add, add_le
	if layout.little then put, turn = turn, put end
	return load(table.concat(text, "\n"))(add, put, turn, cut, readable, mark, fields, names)
end

for _, layout in pairs(D.layouts) do
	for _, slot in ipairs(layout.fields) do
		if not slot.kind:find("int") then
			slot.record = new_field(layout.protocol, slot.abbreviation, slot.kind, slot.name, nil, slot.doc)
		else
			slot.record = new_field(
				layout.protocol, slot.abbreviation, slot.kind, slot.name, slot.hex and base.HEX or base.DEC,
				not slot.special and slot.names or nil, slot.mask, slot.doc
			)
		end
	end
	layout.proto, layout.add_all = P[layout.protocol], adder(layout, layout.fields)
	if layout.title == TITLES[layout.protocol] then layout.title = nil end  -- Wireshark says so by itself
end

local F = {
	buffer_length = new_field("edoras", "edoras.buffer_length", "uint64", "buffer_length", base.DEC),
	buffer_capacity = new_field("edoras", "edoras.buffer_capacity", "uint64", "buffer_capacity", base.DEC),
	spare = new_field("edoras", "edoras.spare", "uint64", "spare", base.HEX),
	crc = new_field("edoras", "edoras.crc", "uint32", "crc", base.HEX),
	link = new_field("edoras", "edoras.link", "string", "Link"),
	msg_id = new_field("edoras", "edoras.msg_id", "uint16", "MsgId", base.HEX),
	name = new_field("edoras", "edoras.name", "string", "Name"),
	topic = new_field("edoras", "edoras.topic", "string", "Topic"),
	type = new_field("edoras", "edoras.type", "string", "Type"),
	command = new_field("edoras", "edoras.command", "string", "Command"),
	mission_time = new_field("edoras", "edoras.mission_time", "double", "Mission time, s since its epoch"),
	mission_utc = new_field("edoras", "edoras.mission_utc", "string", "Mission time, UTC"),
	finding = new_field("edoras", "edoras.finding", "string", "Finding"),
	text = new_field("edoras", "edoras.message", "string", "Message"),
	stop = new_field("edoras", "edoras.stop", "string", "Decoded no further"),
	padding = new_field("edoras", "edoras.padding", "bytes", "Padding"),
	gap = new_field("edoras", "edoras.gap", "uint16", "Packets missing before this one", base.DEC),
	duplicate = new_field("edoras", "edoras.duplicate", "bool", "Same sequence count and bytes as an earlier packet"),
	reordered = new_field("edoras", "edoras.reordered", "bool", "Came after a packet with a higher sequence count"),
	body = new_field("ros2cdr", "ros2cdr.body", "bytes", "Body"),
}

local SEVERITY = {note = expert.severity.NOTE, warning = expert.severity.WARN, error = expert.severity.ERROR}
local RANK = {note = 1, warning = 2, error = 3}
local MARK = {warning = "! ", error = "\226\156\151 "}
local FINDINGS, FINDING = D.findings, {}  -- label to index
local experts = {}
for index, finding in ipairs(FINDINGS) do
	FINDING[finding.label] = index
	finding.rank = RANK[finding.severity]
	finding.badge = (MARK[finding.severity] or "") .. finding.short
	finding.expert = ProtoExpert.new(
		"edoras.finding." .. finding.label, finding.meaning, expert.group.PROTOCOL, SEVERITY[finding.severity]
	)
	table.insert(experts, finding.expert)
end
local EXPERT = {
	gap = ProtoExpert.new(
		"edoras.analysis.gap", "The sequence count skips packets: lost before this capture, or not sent here",
		expert.group.SEQUENCE, expert.severity.WARN
	),
	duplicate = ProtoExpert.new(
		"edoras.analysis.duplicate", "The sequence count and the bytes of an earlier packet",
		expert.group.SEQUENCE, expert.severity.WARN
	),
	reordered = ProtoExpert.new(
		"edoras.analysis.reordered", "The packet came late: packets with higher sequence counts came before it",
		expert.group.SEQUENCE, expert.severity.NOTE
	),
}
for _, made in pairs(EXPERT) do table.insert(experts, made) end

-- Which link a datagram belongs to: of the links that claim its port, the one that is surest. cpu2's CI port equals
-- TO's destination port (both 1235): a port alone does not tell.

local ports, stream_ports, link_by_label = {}, {}, {}
for _, link in ipairs(D.links) do
	ports[link.label], link_by_label[link.label] = {}, link
	link.form_ports = {}
	for _, form in pairs(link.forms or {}) do
		if form.port then link.form_ports[form.port] = true end
	end
end
local bridge_ports, cfs = {}, {}
for _, port in ipairs(D.bridge_ports) do bridge_ports[port] = true end
for index, address in ipairs(D.cfs_addresses) do cfs[index] = Address.ip(address) end

local function is_cfs(address)
	for _, known in ipairs(cfs) do
		if address == known then return true end
	end
	return false
end

-- Tell whether a datagram is for cFS, or nil where the addresses do not tell.
local function is_for_cfs(pinfo)
	if #cfs == 0 then return nil end
	local to, from = pinfo.dst, pinfo.src
	if to == from then return nil end
	local for_cfs = is_cfs(to)
	if for_cfs == is_cfs(from) then return nil end
	return for_cfs
end

-- Tell whether a link's first header holds the values that it always holds.
local function holds_constants(link, s)
	local layout = D.layouts[link.headers[1]]
	if #s < layout.size then return false end
	local values = {D.read[link.headers[1]](s, 1)}
	for name, value in pairs(link.constants) do
		if values[layout.place[name]] ~= value then return false end
	end
	return true
end

-- Tell whether the first doubles are likely values, where byte HIGH of each holds the sign and the exponent, LOW the rest.
local function likely_doubles(s, count, high, low)
	for at = 0, 8 * (count - 1), 8 do
		local first, second = byte(s, at + high), byte(s, at + low)
		if first and second then
			local exponent = first % 128 * 16 + (second - second % 16) / 16
			if exponent ~= 0 and (exponent < D.doubles.smallest or exponent > D.doubles.largest) then return false end
		end
	end
	return true
end

local RECOGNISED = {}  -- links whose bytes are asked by a function

-- How sure a link is that a datagram is its own, 0 for not at all: as LinkProtocol.recognise.
local function likeness(link, pinfo, s, length)
	local sure, recognised = link.sure, RECOGNISED[link.label]
	if recognised then return recognised(s, length) and D.sure.by_content or 0 end
	if link.forms then
		local form = link.forms[#s]
		if not form then return 0 end
		if form.port and form.port ~= pinfo.dst_port and link.form_ports[pinfo.dst_port] then return 0 end
		local count = form.doubles
		if count and not likely_doubles(s, count, 8, 7) and not likely_doubles(s, count, 1, 2) then return 0 end
		return D.sure.by_content
	elseif link.constants then
		if not holds_constants(link, s) then return 0 end
		sure = D.sure.by_content
	end
	if link.to_cfs == link.from_cfs then return sure end
	local first = byte(s, link.header_bytes + 1)
	local command = not first or first % 32 >= 16  -- TO never sends an empty datagram
	if command == link.to_cfs then sure = sure + 1 end
	local for_cfs = is_for_cfs(pinfo)
	if for_cfs ~= nil and for_cfs == link.to_cfs then sure = sure + D.sure.by_address end
	return sure
end

local TCP = 2  -- what pinfo.port_type says of TCP
-- Return the link of a message of a TCP stream, or nil for none.
local function stream_link_of(pinfo, s, length)
	for _, port in ipairs({pinfo.dst_port, pinfo.src_port}) do
		for _, link in ipairs(D.links) do
			local claimed = stream_ports[link.label]
			if claimed and claimed[port] then
				local recognised = RECOGNISED[link.label]
				return (not recognised or recognised(s, length)) and link or nil
			end
		end
	end
end

-- Return the link of so many bytes, of which the capture may have cut some; nil for none.
local function link_of(pinfo, s, length)
	if pinfo.port_type == TCP then return stream_link_of(pinfo, s, length) end
	local destination, source = pinfo.dst_port, pinfo.src_port
	local best, found, ours = 0, nil, false
	for _, link in ipairs(D.links) do
		local claimed = ports[link.label]
		if claimed[destination] then
			ours = true
			local sure = likeness(link, pinfo, s, length)
			if sure > 0 and sure >= best then best, found = sure, link end
		elseif claimed[source] then
			ours = true
			if link.sender_port and best == 0 then found = link end
		end
	end
	if ours then return found end
	-- "Decode As": no port of ours has a say.
	for _, link in ipairs(D.links) do
		if link.to_cfs ~= link.from_cfs and #link.headers == 0 then
			local sure = likeness(link, pinfo, s, length)
			if sure >= best then best, found = sure, link end
		end
	end
	return found
end

-- CDR bodies by message type. A type is a list of steps, as in edoras_tools.ros.plan: a "run" of primitives at
-- fixed offsets from an aligned start, a "text", or a "repeat" of other steps. Positions are places in the
-- datagram's string, from 1; alignment counts from the body's first byte.

local KINDS = {
	["?"] = "bool", b = "int8", B = "uint8", h = "int16", H = "uint16", i = "int32", I = "uint32",
	q = "int64", Q = "uint64", f = "float", d = "double",
}
local CODES = {
	["?"] = "B", b = "b", B = "B", h = "i2", H = "I2", i = "i4", I = "I4", q = "e", Q = "E", f = "f", d = "d",
}
local MOST_AT_ONCE = 64

local records  -- of the type that is compiled

local function ros_field(abbreviation, kind, ...)
	local record = new_field("ros2cdr", abbreviation, kind, ...)
	records[#records + 1] = record
	return record
end

local function value_field(abbreviation, name, code, array)
	if array and code == "B" then
		return ros_field(abbreviation, "bytes", name)
	elseif code == "?" or code == "f" or code == "d" then
		return ros_field(abbreviation, KINDS[code], name)
	end
	return ros_field(abbreviation, KINDS[code], name, base.DEC)
end

-- A list's number of elements. No ROS field's name begins with an underscore.
local function count_field(path, name)
	return ros_field(path .. "._count", "uint32", name .. " items", base.DEC)
end

-- How a leaf's value is said in a few words, as a format: numbers only, and "nan" has its own spelling.
local function format_of_words(leaf)
	if leaf.code == "?" then return leaf.name .. "=True" end
	return leaf.name .. (leaf.code:find("[fd]") and "=%.6g" or "=%d")
end

-- Give a run of single values one format for them all.
local function compile_run(run)
	local format, position = {}, 0
	for index, leaf in ipairs(run.leaves) do
		if leaf.count or index > MOST_AT_ONCE then return end
		format[#format + 1] = string.rep("x", leaf.offset - position) .. CODES[leaf.code]
		position = leaf.offset + leaf.size
	end
	run.little, run.big = "<" .. table.concat(format), ">" .. table.concat(format)
end

-- Give every leaf its field. Elements have no index in a field's name.
local function compile(steps, prefix, array)
	for _, step in ipairs(steps) do
		if step.leaves then
			for _, leaf in ipairs(step.leaves) do
				local path = prefix .. (leaf.name ~= "" and "." .. leaf.name or "")
				local many = leaf.count ~= nil or (array and leaf.name == "")
				leaf.many = many
				if leaf.count then leaf.counter = count_field(path, leaf.name) end
				leaf.record = value_field(path, leaf.name ~= "" and leaf.name or path:match("[^.]*$"), leaf.code, many)
				leaf.little, leaf.big = "<" .. CODES[leaf.code], ">" .. CODES[leaf.code]
				leaf.field, leaf.form, leaf.in_header = leaf.record.field, format_of_words(leaf), leaf.name:sub(1, 7) == "header."
				leaf.wide = leaf.code == "q" or leaf.code == "Q"  -- objects, which equal no number
			end
			compile_run(step)
		else
			local path = prefix .. (step.name ~= "" and "." .. step.name or "")
			if step.steps then
				step.counter = count_field(path, step.name ~= "" and step.name or path:match("[^.]*$"))
				step.item = ros_field(path .. "._item", "none", "Item")
				compile(step.steps, path, true)
			else
				step.record = ros_field(path, "string", step.name ~= "" and step.name or path:match("[^.]*$"))
			end
		end
	end
end

for name, kind in pairs(D.types) do
	local prefix = "ros2." .. name:gsub("/msg/", "."):gsub("/", ".")
	kind.records = {}
	records = kind.records
	kind.record = ros_field(prefix, "none", name)
	compile(kind.steps, prefix, false)
end

local function count_at(s, p, start, big)
	p = p + (start - p) % 4
	local b0, b1, b2, b3 = byte(s, p, p + 3)
	if big then b0, b1, b2, b3 = b3, b2, b1, b0 end
	return b0 + 256 * (b1 + 256 * (b2 + 256 * b3)), p + 4
end

-- Return where a body ends, or nil where it is not valid. `stop` is the last place that belongs to it.
local function check(steps, s, p, start, stop, big)
	for index = 1, #steps do
		local step = steps[index]
		if step.leaves then
			p = p + (start - p) % step.alignment + step.size
			if p - 1 > stop then return nil end
		else
			local count = step.count
			if not count then
				if p + (start - p) % 4 + 3 > stop then return nil end
				count, p = count_at(s, p, start, big)
			end
			if step.steps then
				if (step.bound > 0 and count > step.bound) or p + count * step.least - 1 > stop then return nil end
				if step.uniform and count > 0 then
					p = p + (start - p) % step.uniform.alignment + count * step.uniform.size
					if p - 1 > stop then return nil end
				else
					for _ = 1, count do
						p = check(step.steps, s, p, start, stop, big)
						if not p then return nil end
					end
				end
			else
				local narrow = step.width == 1 and 1 or 0
				p = p + count * step.width
				if p - 1 > stop or (narrow == 1 and count > 0 and byte(s, p - 1) ~= 0)
					or (step.bound > 0 and count - narrow > step.bound) then
					return nil
				end
			end
		end
	end
	return p
end

-- Return how many bytes follow a body's last field, or nil where it is no message of this type.
local function bytes_left(kind, s, start, stop, big)
	if kind.fixed then
		local left = stop - start + 1 - kind.fixed
		return left >= 0 and left or nil
	end
	local p = check(kind.steps, s, start, start, stop, big)
	return p and stop + 1 - p
end

-- A message in a few words, for the packet list.

local MOST_WORDS, MOST_ITEMS = 8, 3  -- what fits in one line

local function text_value(step, s, p, count, big)
	if step.width == 1 then
		return utf8_text(s:sub(p, p + count - 2))
	end
	return wide_text(s, p, p + count * step.width - 1, step.width, big)
end

-- A primitive in a few characters.
local function short_value(leaf, value)
	local code = leaf.code
	if code == "d" or code == "f" then
		return value ~= value and "nan" or format("%.6g", value)
	elseif code == "?" then
		return value ~= 0 and "True" or "False"
	elseif leaf.size == 8 then
		return tostring(value)
	end
	return format("%d", value)
end

local function value_at(leaf, s, p, big)
	return (unpack(big and leaf.big or leaf.little, s, p))
end

local function listed(items, count)
	return "[" .. table.concat(items, ", ") .. (count > MOST_ITEMS and format(", ... %d", count) or "") .. "]"
end

local function short_numbers(leaf, s, p, count, big)
	local items = {}
	for index = 1, math.min(count, MOST_ITEMS) do
		items[index] = short_value(leaf, value_at(leaf, s, p + (index - 1) * leaf.size, big))
	end
	return listed(items, count)
end

local short_message

-- Append the words of a list of messages or texts; return where it ends.
local function short_list(step, s, p, start, big)
	local items, count = {}, step.count
	if not count then count, p = count_at(s, p, start, big) end
	if step.element and count > 0 then
		local leaf = step.steps[1].leaves[1]
		p = p + (start - p) % leaf.size
		return short_numbers(leaf, s, p, count, big), p + count * leaf.size
	end
	for index = 1, count do
		if index > MOST_ITEMS then
			p = check(step.steps, s, p, start, #s, big)
		elseif step.unnamed then
			local inner = step.steps[1]
			if inner.steps then
				items[index], p = short_list(inner, s, p, start, big)
				items[index] = items[index] or "[]"
			else
				local length
				length, p = count_at(s, p, start, big)
				items[index] = text_value(inner, s, p, length, big)
				p = p + length * inner.width
			end
		else
			local text
			text, p = short_message(step.steps, s, p, start, big, true)
			items[index] = "{" .. text .. "}"
		end
	end
	return count > 0 and listed(items, count) or nil, p
end

local words, header = {}, {}  -- of the message that is told; lists of messages have their own

local function say(name, value)
	local list = name:sub(1, 7) == "header." and header or words
	list[#list + 1] = name .. "=" .. value
end

-- Say the single values of a run, decoded at once where they can be. A zero is not said; -0.0 is one too.
local function say_run(run, s, p, big)
	local values = run.little and {unpack(big and run.big or run.little, s, p)}
	local leaves = run.leaves
	for index = 1, #leaves do
		local leaf = leaves[index]
		if leaf.count then
			say(leaf.name, short_numbers(leaf, s, p + leaf.offset, leaf.count, big))
		elseif not leaf.hidden then
			local value = values and values[index] or value_at(leaf, s, p + leaf.offset, big)
			if leaf.wide or value ~= value then
				value = short_value(leaf, value)
				if value ~= "0" then say(leaf.name, value) end
			elseif value ~= 0 then
				local list = leaf.in_header and header or words
				list[#list + 1] = format(leaf.form, value)
			end
		end
	end
end

-- Return a message in a few words: zeros left out, long arrays cut, the header last; and where it ends, which
-- is known only where `whole` is asked for.
function short_message(steps, s, p, start, big, whole)
	local outer_words, outer_header = words, header
	words, header = {}, {}
	for index = 1, #steps do
		local step = steps[index]
		if #words > MOST_WORDS and not whole then break end
		if step.leaves then
			p = p + (start - p) % step.alignment
			say_run(step, s, p, big)
			p = p + step.size
		elseif step.steps then
			local text
			text, p = short_list(step, s, p, start, big)
			if text then say(step.name, text) end
		else
			local length
			length, p = count_at(s, p, start, big)
			if length > (step.width == 1 and 1 or 0) then
				say(step.name, text_value(step, s, p, length, big))
			end
			p = p + length * step.width
		end
	end
	local told, total = words, #words
	for _, word in ipairs(header) do
		total = total + 1
		told[total] = word
	end
	words, header = outer_words, outer_header
	if total == 0 then return "all zero", p end
	if total <= MOST_WORDS then return table.concat(told, " "), p end
	return table.concat(told, " ", 1, MOST_WORDS) .. " ...", p
end


local sequence = (function()
-- Sequence counts, followed by the rules of edoras_tools.sessions.sequence, which say what is meant here.
-- What a later packet shows to be no gap, or not late, is taken back: the second pass over a file knows more.

local MODULUS = D.limits.sequence_modulus
local FORWARD = MODULUS / 2
local WINDOW, REPEATED, BOOT_APART = 1024, 128, 3  -- counts, seconds
local FIRST_COUNTS, REMEMBERED, GOES_ON, LEAST_HOLE, MOST_STRANDS = 64, FORWARD / 2, 3, 16, 8

local function position_of(strand, count)
	return strand.last + (count - strand.last + FORWARD) % MODULUS - FORWARD
end

local function hole_at(strand, position)
	for index = #strand.holes, 1, -1 do
		local hole = strand.holes[index]
		if hole.first <= position then
			if position < hole.stop then return hole, index end
			return nil
		end
	end
	return nil
end

local function unknown(position)  -- what may come late before a strand's first packet: nobody missed it
	return {first = position - WINDOW, stop = position}
end

local function new_strand(position, packet, holes)
	return {
		last = position, boot = packet.boot, bodies = {[position % REPEATED] = packet.body}, holes = holes, place = packet.place,
		front = 0, behind = 0, late = {},
	}
end

-- Put a strand first; forget those that did not move for long.
local function add_strand(stream, strand)
	local strands = {strand}
	for _, other in ipairs(stream.strands) do
		if #strands < MOST_STRANDS and strand.place - other.place <= REMEMBERED then
			strands[#strands + 1] = other
		end
	end
	stream.strands = strands
end

local function went_on(stream, strand, packet)
	strand.place, strand.moved, stream.moved = packet.place, true, true
	local strands = stream.strands
	if strands[1] == strand then return end
	for index = 2, #strands do
		if strands[index] == strand then table.remove(strands, index) end
	end
	table.insert(strands, 1, strand)
end

local function advance(stream, strand, packet)
	strand.last = strand.last + 1
	strand.bodies[strand.last % REPEATED] = packet.body
	strand.boot = packet.boot or strand.boot
	strand.front = strand.front + 1
	local holes = strand.holes
	while holes[1] do
		local kept = holes[1].stop - holes[1].first > WINDOW and REMEMBERED or WINDOW
		if holes[1].stop > strand.last - kept then break end
		table.remove(holes, 1)
	end
	went_on(stream, strand, packet)
end

local function begin_strand(stream, strand)
	if #stream.strands > 0 then stream.moved = true end
	add_strand(stream, strand)
end

-- Take counts of a hole for not missing after all.
local function find(hole, count)
	if hole.gap then
		local left = hole.gap.missing - count
		hole.gap.missing = left
		analysis[hole.gap.frame] = left > 0 and left or nil
	end
end

-- Make the packets in front of a hole another sender's.
local function divide(stream, strand, hole, index, position, packet)
	local taken_back = math.max(#strand.late - 1, 0)
	for place = 1, taken_back do analysis[strand.late[place]] = nil end
	strand.late = {}
	local other = new_strand(position, packet, {})
	other.moved = true
	if not hole.gap then
		other.holes[1] = unknown(position - taken_back)
		begin_strand(stream, other)
		return
	end
	find(hole, hole.stop - position)
	local above = {unknown(hole.stop)}
	for place, item in ipairs(strand.holes) do
		if place < index then other.holes[place] = item end
		if place > index then above[#above + 1] = item end
	end
	if position > hole.first then
		other.holes[index] = {first = hole.first, stop = position, gap = hole.gap}
	end
	strand.holes = above
	add_strand(stream, other)
	went_on(stream, other, packet)
end

local function fill(strand, hole, index, position)
	if position == hole.first then
		hole.first = position + 1
	else
		if position + 1 < hole.stop then
			table.insert(strand.holes, index + 1, {first = position + 1, stop = hole.stop, gap = hole.gap})
		end
		hole.stop = position
	end
	if hole.first == hole.stop then table.remove(strand.holes, index) end
end

local function comes_late(stream, strands, packet, missed)
	for _, strand in ipairs(strands) do
		local position = position_of(strand, packet.count)
		local hole, index = hole_at(strand, position)
		if hole and (hole.gap ~= nil) == missed then
			if position > strand.last - WINDOW then
				if position ~= hole.first and missed then
					strand.late = {}
				elseif #strand.late == 0 or position ~= strand.behind then
					strand.late, strand.front = {packet.frame}, 0
				else
					strand.late[#strand.late + 1] = packet.frame
				end
				strand.behind = position + 1
				if #strand.late >= GOES_ON and (not missed or strand.front >= GOES_ON - 1)
					and hole.stop - position > LEAST_HOLE then
					divide(stream, strand, hole, index, position, packet)
					return true
				end
				if position > strand.last - REPEATED then strand.bodies[position % REPEATED] = packet.body end
				find(hole, 1)
				fill(strand, hole, index, position)
				analysis[packet.frame], stream.moved = "reordered", true
				return true
			elseif hole.stop - hole.first > WINDOW then
				strand.late = {}
				divide(stream, strand, hole, index, position, packet)
				return true
			end
		end
	end
	return false
end

-- It is one only where the count moves; its bytes are those of an earlier one in any case.
local function comes_twice(stream, packet)
	stream.again = true
	if stream.moved then analysis[packet.frame] = "duplicate" end
end

local function comes_again(stream, strands, packet)
	for _, strand in ipairs(strands) do
		local position = position_of(strand, packet.count)
		if position <= strand.last and position > strand.last - REPEATED and not hole_at(strand, position) then
			if strand.bodies[position % REPEATED] == packet.body then
				comes_twice(stream, packet)
				return true
			elseif not strand.moved and position == strand.last then
				strand.bodies[position % REPEATED] = packet.body
				return true
			end
		end
	end
	return false
end

local function is_ahead(stream, strands, packet, reach)
	local nearest, least = nil, reach + 1
	for _, strand in ipairs(strands) do
		local step = position_of(strand, packet.count) - strand.last
		if step > 0 and step < least then nearest, least = strand, step end
	end
	if not nearest or (least > WINDOW and packet.count < FIRST_COUNTS and not (packet.boot and nearest.boot)) then
		return false
	end
	local gap = {frame = packet.frame, missing = least - 1}
	analysis[packet.frame] = gap.missing
	table.insert(nearest.holes, {first = nearest.last + 1, stop = nearest.last + least, gap = gap})
	nearest.last = nearest.last + least - 1
	advance(stream, nearest, packet)
	nearest.late = {}
	return true
end

-- Take a packet of a stream: its count, frame number and bytes, and its boot, where it has a time.
local function follow_count(stream, packet)
	local count, boot = packet.count, packet.boot
	stream.place = stream.place + 1
	packet.place = stream.place
	local again = stream.count == count and stream.body == packet.body
	stream.count, stream.body, stream.again = count, packet.body, false
	if again then return comes_twice(stream, packet) end
	local strands = {}
	for _, strand in ipairs(stream.strands) do
		if not boot or not strand.boot or math.abs(boot - strand.boot) <= BOOT_APART then
			strands[#strands + 1] = strand
		end
	end
	for _, strand in ipairs(#strands > 0 and strands or stream.strands) do
		if (strand.last + 1) % MODULUS == count then
			advance(stream, strand, packet)
			return
		end
	end
	if not (comes_late(stream, strands, packet, true) or comes_again(stream, strands, packet)
		or is_ahead(stream, strands, packet, WINDOW) or comes_late(stream, strands, packet, false)
		or is_ahead(stream, strands, packet, FORWARD)) then
		begin_strand(stream, new_strand(count, packet, {unknown(count)}))
	end
end

return {follow = follow_count}
end)()

-- The work on one datagram, and the headers of the links.

local W = {serial = 0, layer = {}, at = {}, inside = {}, found = {}, is_found = {}}
local peers, sequences = {}, {}  -- what is known of senders, see init()
local read, L = D.read, D.layouts
local identities = {}
for _, pair in ipairs(D.identities) do
	identities[pair[2]] = identities[pair[2]] or {}
	identities[pair[2]][pair[1]] = true
end

-- `key` is of these bytes alone; `listed` tells whether anybody sees the columns, `cut_off` whether bytes are missing.
local function begin(s, link, pinfo, key, listed, cut_off)
	W.serial = W.serial + 1
	W.s, W.link, W.pinfo, W.key, W.listed, W.cut = s, link, pinfo, key, listed, cut_off
	W.layers, W.findings, W.entries, W.spacecraft, W.processor, W.bare = 0, 0, 0, 0, 0, false
	W.stop, W.kind, W.msg_id, W.code, W.time, W.summary = nil, nil, nil, nil, nil, nil
	W.route, W.message, W.envelope, W.padding, W.known, W.crc_at = nil, nil, nil, nil, nil, nil
	W.pdu, W.packets, W.entries_read, W.text = nil, nil, nil, nil
end

-- Note a finding, once; they stay in the order of their bits.
local function note(label)
	local index = FINDING[label]
	if W.is_found[index] == W.serial then return end
	W.is_found[index] = W.serial
	local found, place = W.found, W.findings + 1
	W.findings = place
	while place > 1 and found[place - 1] > index do
		found[place] = found[place - 1]
		place = place - 1
	end
	found[place] = index
end

local function has(label)
	return W.is_found[FINDING[label]] == W.serial
end

-- Add a header that starts at an offset; `inside` shows what is told below it.
local function add_layer(layout, at, inside)
	local work = W
	local count = work.layers + 1
	work.layers, work.layer[count], work.at[count], work.inside[count] = count, layout, at, inside
end

-- Note that a header is cut. Offsets count from the datagram's first byte, from 0.
local function truncated(name, at, need)
	note("truncated")
	W.stop = format("%s at byte %d needs %d bytes, %d are there", name, at, need, math.max(0, #W.s - at))
end

-- Take a header that must be whole; tell whether it is.
local function take(layout, at)
	if #W.s - at < layout.size then
		truncated(layout.name, at, layout.size)
		return false
	end
	add_layer(layout, at)
	return true
end

-- Tell the older 7-byte header: its size fits, and so does what then follows it.
local function is_legacy(s)
	local at = L.sbn_legacy.size
	if #s < at then return false end
	local size, kind = read.sbn_legacy(s, 1)
	if size ~= #s - at or not D.sbn.names[kind] then
		return false
	elseif kind == D.sbn.APP then
		return size >= L.ccsds.size and select(7, read.ccsds(s, at + 1)) + D.limits.length_bias == size
	elseif kind == D.sbn.PROTO then
		return size == L.sbn_proto.size
	elseif kind == D.sbn.SUB or kind == D.sbn.UNSUB then
		return s:sub(at + 1, at + 1) == "$"
	end
	return size == 0
end

local source, source_text  -- the last address: most datagrams come from where the one before did

-- Return the table that another has under a key.
local function nested(outer, key)
	local inner = outer[key]
	if not inner then
		inner = {}
		outer[key] = inner
	end
	return inner
end

-- Return what is known of the endpoint that a datagram came from: a table in `places`, by address and port.
local function sender(places)
	local address, port = W.pinfo.src, W.pinfo.src_port
	if address ~= source then source, source_text = address, tostring(address) end
	return nested(places, source_text), port
end

-- Return what is known of the endpoint that a datagram goes to.
local function receiver(places)
	return nested(places, tostring(W.pinfo.dst)), W.pinfo.dst_port
end

-- Compare a sender with the one its endpoint is known by: the first identity that it gave.
local function identify(spacecraft, processor, trusted)
	local place, port = sender(peers)
	local known = place[port]
	if trusted and not known then
		known = {spacecraft = spacecraft, processor = processor, since = W.pinfo.number}
		place[port] = known
	end
	if known and known.since < W.pinfo.number
		and (known.spacecraft ~= spacecraft or known.processor ~= processor)
		and not (identities[processor] and identities[processor][spacecraft]) then
		note("sbn_id_mismatch")
	end
end

local IDENT = D.sbn.ident .. string.rep("\0", D.sbn.ident_bytes - #D.sbn.ident)

local function subscriptions(at)
	if not take(L.sbn_sub, at) then return end
	local s = W.s
	local count = read.sbn_sub(s, at + 1)
	if s:sub(at + 1, at + D.sbn.ident_bytes) ~= IDENT then note("sbn_id_mismatch") end
	local first = at + L.sbn_sub.size
	local size = L.subscription.size
	W.entries = math.min(count, math.floor((#s - first) / size))
	if W.listed then
		local some = {}
		for index = 0, math.min(W.entries, 3) - 1 do
			some[index + 1] = format("0x%04x", (read.subscription(s, first + index * size + 1)))
		end
		W.summary = table.concat(some, ", ") .. (W.entries > 3 and format(" and %d more", W.entries - 3) or "")
	end
	if #s - first < count * size then truncated(L.subscription.name, first, count * size) end
end

-- Read the SBN header and what is its own; return where a space packet starts, if one does.
local function software_bus_network(s)
	local legacy = is_legacy(s)
	local layout = legacy and L.sbn_legacy or L.sbn
	if legacy then note("sbn_legacy_header") end
	if #s >= L.sbn.size and #s % D.limits.bridge_modulus < L.sbn.size and bridge_ports[W.pinfo.dst_port]
		and W.pinfo.port_type ~= TCP then
		note("bridge_drops_length")
	end
	if not take(layout, 0) then return nil end
	local size, kind, processor, spacecraft
	if legacy then
		size, kind, processor = read.sbn_legacy(s, 1)
		spacecraft = 0
	else
		size, kind, processor, spacecraft = read.sbn(s, 1)
	end
	local known, payload = D.sbn.names[kind], #s - layout.size
	W.kind, W.spacecraft, W.processor = known or format("0x%02x", kind), spacecraft, processor
	if size ~= payload then note("sbn_size_mismatch") end
	if not known then note("sbn_unknown_type") end
	if kind == D.sbn.NO_MSG then note("sbn_no_message") end
	identify(spacecraft, processor, known and size == payload)
	if kind == D.sbn.APP then return layout.size end
	if kind == D.sbn.SUB or kind == D.sbn.UNSUB then
		subscriptions(layout.size)
	elseif kind == D.sbn.PROTO and take(L.sbn_proto, layout.size) then
		local version = read.sbn_proto(s, layout.size + 1)
		W.summary = format("protocol version %d", version)
		if version ~= D.sbn.version then note("sbn_version_mismatch") end
	end
	if W.listed then
		local from = legacy and format("from ?:%d", processor) or format("from %d:%d", spacecraft, processor)
		W.summary = (W.summary and W.summary ~= "") and W.summary .. " " .. from or from
	end
	return nil
end

-- Return a header as the steps of a message: its numbers say what it is, of an array the first.
local function steps_of(layout)
	if not layout.steps then
		local leaves, name, codes = {}, nil, {
			double = "d", float = "f", int8 = "i1", int16 = "i2", int32 = "i4", uint8 = "I1", uint16 = "I2", uint32 = "I4",
		}
		for _, slot in ipairs(layout.fields) do
			local code = not slot.mask and slot.name ~= name and codes[slot.kind]
			name = slot.name
			if code then leaves[#leaves + 1] = {
				name = slot.name, offset = slot.start, size = slot.size, code = code, big = ">" .. code, little = "<" .. code,
				form = slot.name .. (code:find("[fd]") and "=%.6g" or "=%d"),
			} end
		end
		layout.steps = {{leaves = leaves, alignment = 1, size = layout.size}}
	end
	return layout.steps
end

-- Read the headers of a link that has the same ones always, or by its length.
local function read_headers(s, link)
	local form, at = link.forms and link.forms[#s], 0
	for _, name in ipairs(form and form.headers or link.headers) do
		if not take(L[name], at) then return nil end
		if link.values then
			if W.listed then W.summary = short_message(steps_of(L[name]), s, at + 1, at + 1, false) end
		elseif not link.packets then
			W.summary = L[name].title or link.title
		end
		at = at + L[name].size
	end
	return link.packets and at or nil
end

-- Links whose headers hang on what they hold read them by themselves.
local HEADER_READERS = {sbn = software_bus_network}

-- Space packets: the primary header, cFE's headers, what cFE itself sends, and the EDORAS envelope.

local routes = D.routes
local settings = {}
local known_of = {}

-- Take what the preferences say of the headers and MsgIds; all the rest follows from it.
local function settle(extended, short, second)
	extended, settings.second = extended or second, second
	for _, link in ipairs(D.links) do known_of[link.label] = {} end
	local telemetry = extended and "telemetry_extended" or short and "telemetry_short" or "telemetry"
	settings.extra = extended and L.extended.size or 0
	settings.command = extended and L.command_extended or L.command
	settings.telemetry, settings.read_time = L[telemetry], read[telemetry]
	settings.command_header = L.ccsds.size + settings.extra + settings.command.size
	settings.telemetry_header = L.ccsds.size + settings.extra + settings.telemetry.size
end
settle(
	D.extended_header, D.telemetry_header == L.ccsds.size + L.telemetry_short.size, D.msg_id_version == 2
)
for _, form in ipairs(D.formats) do
	form.read = read[form.reader]
end
for _, route in ipairs(routes) do
	route.format = D.formats[route.format]  -- nil where the bytes shall tell
	route.kind = D.types[route.type]
end

-- The MsgId of version 1 that the names and commands of cFE have, of one of version 2.
local function known_id(msg_id)
	if not settings.second then return msg_id end
	local high, command = math.floor(msg_id / 256), math.floor(msg_id / 128) % 2
	local third, fourth = math.floor(high / 8) % 2, math.floor(high / 16) % 2
	local secondary = 1 - (fourth + command * third) % 2
	return math.floor(high / 32) * 8192 + command * 4096 + secondary * 2048
		+ high % 8 * 256 + third * 128 + msg_id % 128
end

-- What is known of a MsgId on a link: its name, the routes that may claim it, its commands.
local function look_up(link, msg_id)
	local exact, any_link, id = D.exact[link], D.any_link[msg_id], known_id(msg_id)
	local commands, name = D.commands[id], D.pdu_msg_ids[msg_id] and D.pdu_name or D.msg_id_names[id]
	local own = D.structs[msg_id]
	if own and not any_link then name = own.name or name end
	if not commands and any_link and id % 8192 >= 4096 then commands = D.route_commands end
	return {
		claims = exact and exact[msg_id] or any_link, commands = commands,
		name = name, topic = any_link and routes[any_link[1]].topic or "",
		unknown = not name and not any_link and not own, heads = {},
	}
end

local function about(link, msg_id)
	local known = known_of[link][msg_id]
	if not known then
		known = look_up(link, msg_id)
		if not known.unknown then known_of[link][msg_id] = known end  -- all others may be too many to keep
	end
	return known
end

local function name_of(known)
	return known.name or (W.route and W.route.topic) or known.topic
end

local LENGTH_BIAS, LONGEST, HIGHEST_MSG_ID = D.limits.length_bias, D.limits.software_bus, D.limits.highest_msg_id
local HEADER = L.ccsds.size

-- Follow the sequence count of a stream: one MsgId of one sender on one link.
local function follow(msg_id, count, start)
	if W.pinfo.visited then return end
	local spacecraft, key = nested(sequences, W.spacecraft), msg_id * 256 + link_by_label[W.link].code
	local endpoints = nested(nested(spacecraft, W.processor), key)
	local place, port
	if W.spacecraft > 0 or W.processor > 0 then
		place, port = receiver(endpoints)
	else
		place, port = sender(endpoints)
	end
	place[port] = place[port] or {strands = {}, place = 0}
	sequence.follow(place[port], {
		count = count, frame = W.key, body = W.s:sub(start + 1),
		boot = W.time and W.time > 0 and W.pinfo.abs_ts - W.time or nil,
	})
end

-- Judge a command's checksum and function code.
local function command(code, sent, start, length, extra)
	if checksum(W.s, start + 1, start + length) ~= 0 then
		note(sent == 0 and "checksum_absent" or "checksum_bad")
	end
	local commands = W.known.commands
	if not commands then return end
	local known = commands[code]
	if not known then
		note("unknown_function_code")
	elseif known.lengths then
		local total = #W.s - start - settings.command_header + L.ccsds.size + L.command.size
		for _, length_taken in ipairs(known.lengths) do
			if total == length_taken then return end
		end
		note("command_length")
	end
end

-- Tell the envelope's format from the bytes: its lengths hold, and an encapsulation follows.
local function detect(s, at)
	for _, form in ipairs(D.formats) do
		local start = at + form.size
		if #s >= start + 4 and not form.own then
			local length, capacity = form.read(s, at + 1)
			if length >= 4 and length <= capacity and length <= #s - start
				and s:find("^\0[\0\1]\0\0", start + 1) then
				return form
			end
		end
	end
	return nil
end

local function envelope_format(route, at)
	return route.format or detect(W.s, at) or D.formats[1]
end

-- Tell whether the bytes hold a whole message of a route.
local function suits(route, at)
	local form, s = envelope_format(route, at), W.s
	local start = at + form.size
	if #s < start + 4 then return false end
	local length = form.read(s, at + 1)
	local representation = length >= 4 and length <= #s - start - (form.crc or 0) and read.cdr(s, start + 1) or 2
	if representation > 1 or not route.kind then return false end
	local left = bytes_left(route.kind, s, start + L.cdr.size + 1, start + length, representation == 0)
	return left ~= nil and left <= route.kind.trailing
end

local function envelope(claims, at)
	local route, s = routes[claims[1]], W.s
	for index = 1, #claims > 1 and #claims or 0 do
		if suits(routes[claims[index]], at) then
			route = routes[claims[index]]
			break
		end
	end
	local form = envelope_format(route, at)
	W.route = route
	if #s - at < form.size then return truncated("edoras", at, form.size) end
	local length, capacity = form.read(s, at + 1)
	local start = at + form.size
	local crc = form.crc or 0
	local space = math.max(0, #s - start - crc)
	W.envelope, W.form = at, form
	if length > space or capacity < length then note("envelope_overrun") end
	if length > space then
		W.stop = format("cdr at byte %d needs %.0f bytes, %d are there", start, length, space)
		return
	elseif length < L.cdr.size then
		note("cdr_invalid")
		W.stop = format("cdr at byte %d needs %d bytes, %d are there", start, L.cdr.size, length)
		return
	end
	local stop = start + length
	if crc > 0 then
		local right = crc == 2 and crc16(s, at + 1, stop) or crc32(s, at + 1, stop)
		if unpack((form.little and "<I" or ">I") .. crc, s, stop + 1) ~= right then note("checksum_bad") end
	end
	if any_nonzero(s, stop + crc + 1, #s) then note("stale_tail") end
	if stop + crc < #s then W.padding = stop + crc end
	W.crc_at = crc > 0 and stop or nil
	local representation = read.cdr(s, start + 1)
	add_layer(L.cdr, start)
	W.body, W.body_end = start + L.cdr.size, stop
	if representation == 0 then note("cdr_big_endian") end
	if representation > 1 then
		note("cdr_invalid")
		W.stop = format("cdr at byte %d has representation 0x%04x; CDR is 0x0000 or 0x0001", start, representation)
		return
	end
	local kind = route.kind
	if not kind then return end
	W.big = representation == 0
	local left = bytes_left(kind, s, W.body + 1, stop, W.big)
	if left then
		W.message = kind
		if left > D.limits.rounded then note(left > kind.trailing and "cdr_too_long" or "cdr_trailing") end
		if W.listed then W.summary = short_message(kind.steps, s, W.body + 1, W.body + 1, W.big) end
	else
		note("cdr_invalid")
		W.stop = format("cdr at byte %d does not decode as %s", start, route.type)
	end
end

-- Say a command with its arguments; one that is usually zero is left out where it is.
local function said_command(layout, s, at)
	local words = {layout.title}
	for _, slot in ipairs(layout.fields) do
		local value, first, last = nil, at + slot.start + 1, at + slot.start + slot.size
		if slot.kind == "string" then
			value = utf8_text(D.text(s, first, last))
			if value == "" or value:find("%s") then value = "'" .. value .. "'" end
		else
			local number = 0
			for place = last, first, -1 do number = number * 256 + s:byte(place) end
			local half = 256 ^ slot.size / 2
			if slot.kind:sub(1, 3) == "int" and number >= half then number = number - 2 * half end
			if number ~= 0 or not slot.silent then
				local digits = math.min(2 * slot.size, 4)
				value = slot.hex and format("0x%0" .. digits .. "x", number) or slot.names and slot.names[number]
					or format("%d", number)
			end
		end
		if value then words[#words + 1] = slot.name .. "=" .. value end
	end
	return table.concat(words, " ")
end

-- Read the struct of a layout that follows the header; a packet of no bytes holds one of its function code alone.
local function own_struct(own, at, code)
	local size = #W.s - at
	local layout = L[code and own[code] or size > 0 and own[-1]]
	if not layout then return end
	if size < layout.size or size > layout.most or (size - layout.size) % (layout.step or 1) > 0 then
		if not has("command_length") then note("struct_length") end
		return
	end
	add_layer(layout, at)
	if W.listed then
		local text = short_message(steps_of(layout), W.s, at + 1, at + 1, not layout.little)
		W.summary = layout.own and layout.title .. "  " .. text or text
	end
end

-- Read what lies behind the cFE header: an event, housekeeping, or a route's envelope.
local function payload(msg_id, start, header, code)
	local at, s = start + header, W.s
	if D.pdu_msg_ids[msg_id] then
		W.pdu = at
		return
	end
	local claims = W.known.claims
	if claims then
		if #s - start > header then return envelope(claims, at) end
		W.route = routes[claims[1]]
		if has("length_mismatch") then return truncated("edoras", at, 1) end
		if code ~= 0 then note("header_only") end
	elseif D.structs[msg_id] then
		own_struct(D.structs[msg_id], at, code)
	elseif known_id(msg_id) == D.msg_id.event and #s - at >= L.event.size then
		add_layer(L.event, at)
		if not W.listed then return end
		local id, _, _, _, app, message = read.event(s, at + 1)
		W.summary = format("%s %d: %s", utf8_text(app), id, utf8_text(message))
	elseif known_id(msg_id) == D.msg_id.software_bus and #s - at >= L.software_bus.size then
		add_layer(L.software_bus, at)
		if not W.listed then return end
		local values = {read.software_bus(s, at + 1)}
		local place = L.software_bus.place
		W.summary = format(
			"pipe overflow %d, message limit %d, no subscribers %d", values[place.pipe_overflow_error_counter],
			values[place.message_limit_error_counter], values[place.no_subscribers_counter]
		)
	elseif code and D.arguments[known_id(msg_id)] then
		local layout = L[D.arguments[known_id(msg_id)][code]]
		if not layout then return end
		if #s - at < layout.size or #s - at > layout.most then
			if not has("command_length") then note("struct_length") end
			return
		end
		add_layer(layout, at)
		if W.listed then W.summary = said_command(layout, s, at) end
	end
end

-- Read a packet that starts at an offset, and all that lies behind its primary header.
local function space_packet(start)
	local work = W
	local s, length = work.s, #work.s - start
	if not take(L.ccsds, start) then return end
	local version, kind, secondary, apid, flags, count, data_length = read.ccsds(s, start + 1)
	local msg_id = version * 8192 + kind * 4096 + secondary * 2048 + apid
	if settings.second then  -- the low byte of the subsystem, where it is there
		msg_id = (s:byte(start + HEADER + 2) or 0) * 256 + kind * 128 + apid % 128
	end
	local extra = settings.extra
	local is_command, total = kind == 1, data_length + LENGTH_BIAS
	local after, link = start + HEADER, work.link
	local known = about(link, msg_id)
	work.msg_id, work.known = msg_id, known
	work.kind = work.kind or (is_command and "cmd" or "tlm")
	if total ~= length then note("length_mismatch") end
	local counted = flags > 0 or count > 0
	if not counted then note("sequence_unset") end
	if total > LONGEST then note("over_software_bus") end
	if msg_id < 1 or msg_id > HIGHEST_MSG_ID then
		note("invalid_msg_id")
	elseif known.unknown then
		note("unknown_msg_id")
	end
	local way = link_by_label[link]
	if way.to_cfs ~= way.from_cfs and is_command ~= way.to_cfs then note("wrong_direction") end

	local as_command = settings.command_header
	local bare = not is_command and length == as_command and total == length and as_command < settings.telemetry_header
	local header = (is_command or bare) and as_command or settings.telemetry_header
	work.bare = bare
	if bare then note("header_only") end
	if extra > 0 and length >= HEADER + extra then add_layer(L.extended, after) end
	if length < header then
		if counted then follow(msg_id, count, start) end
		return truncated(is_command and L.command.name or L.telemetry.name, after, header - HEADER)
	end
	local at, code, sent = after + extra, nil, nil
	if is_command or bare then
		add_layer(settings.command, at)
		local _
		_, code, sent = read.command(s, at + 1)
	else
		add_layer(settings.telemetry, at)
		local seconds, subseconds = settings.read_time(s, at + 1)
		work.time = seconds + subseconds / D.time.ticks
	end
	if counted then follow(msg_id, count, start) end
	if is_command then
		work.code = code
		command(code, sent, start, math.min(length, total), extra)
	end
	if not bare then payload(msg_id, start, header, code) end
end

-- Adding to the tree, which is what costs most: as few calls and ranges as can be.

-- Without a tree for people, only what a filter or a tap refers to is added. What tshark refers to changes only
-- between passes over the packets, and every pass begins before where the last one ended. Wireshark draws single
-- packets amid a pass: it is asked about every packet, and given all fields of one that anything refers to.
local asked = {any = false, protocols = {}, last = math.huge}
local interactive = gui_enabled()

local function look_for_protocols(tree)
	local any = false
	for name in pairs(P) do
		local refers = tree:referenced(Dissector.get(name))
		asked.protocols[name] = refers
		any = any or refers
	end
	return any
end

local function look_for_fields(tree)
	for _, record in ipairs(members) do record.on = tree:referenced(record.field) end
	for _, layout in pairs(D.layouts) do
		local slots = {}
		for _, slot in ipairs(layout.fields) do
			if slot.record.on then slots[#slots + 1] = slot end
		end
		layout.add_asked = adder(layout, slots)
		layout.on = asked.protocols[layout.protocol]
	end
	for _, kind in pairs(D.types) do
		kind.on = kind.record.on
		for _, record in ipairs(kind.records) do kind.on = kind.on or record.on end
	end
end

-- Tell what of a packet shall be added: "all", "some" or nil.
local function look_who_asks(tree, number)
	if tree.visible then return "all" end
	if interactive then return look_for_protocols(tree) and "all" or nil end
	if number <= asked.last then
		asked.any = look_for_protocols(tree)
		if asked.any then look_for_fields(tree) end
	end
	asked.last = number
	return asked.any and "some" or nil
end

-- There are no columns where nobody sees them, as in tshark's trees and fields. As above, tshark does not change
-- its mind amid a pass; passes for trees and for lists are told apart.
local passes = {[true] = {last = math.huge}, [false] = {last = math.huge}}  -- by whether the tree is for people

local function has_columns(pinfo, visible, number)
	local pass = passes[visible]
	if number <= pass.last then pass.columns = interactive or tostring(pinfo.cols.info) ~= "(info)" end
	pass.last = number
	return pass.columns
end

-- Add a header that starts at an offset and that somebody asks for; return its tree.
local function show_layout(tree, layout, tvb, at, visible)
	local bytes = cut(tvb, at, layout.size)
	local node = layout.title and add(tree, layout.proto, bytes, layout.title) or add(tree, layout.proto, bytes)
	local add_slots = visible and layout.add_all or layout.add_asked
	add_slots(node, tvb, at, W.s)
	return node
end

-- Add a value that was not read from bytes; return it, or its parent where nobody asks for it.
local function show_value(node, record, value, visible)
	if not (visible or record.on) then return node end
	local item = add(node, record.field, value)
	if visible then set_generated(item) end
	return item
end

-- A message in the tree: every value with its bytes.

-- Add the node of a list; return it, or its parent where nobody asks for it.
local function show_count(node, counter, range, name, count, visible)
	if not (visible or counter.on) then return node end
	local list = add(node, counter.field, range, count)
	if visible then set_text(list, format("%s: %d items", name, count)) end
	return list
end

local function show_numbers(node, leaf, counter, tvb, p, count, big, name, visible)
	local range = cut(tvb, p - 1, count * leaf.size)
	if leaf.code == "B" then
		if visible or leaf.record.on then add(node, leaf.field, range) end
		return
	end
	node = show_count(node, counter, range, name, count, visible)
	if not (visible or leaf.record.on) then return end
	local put, size = big and add or add_le, leaf.size
	for index = 0, count - 1 do
		put(node, leaf.field, cut(tvb, p + index * size - 1, size))
	end
end

local show_steps

local function show_list(node, step, tvb, s, p, start, big, visible)
	local from, count = p, step.count
	if not count then count, p = count_at(s, p, start, big) end
	if step.element and count > 0 then
		local leaf = step.steps[1].leaves[1]
		p = p + (start - p) % leaf.size
		show_numbers(node, leaf, step.counter, tvb, p, count, big, step.name, visible)
		return p + count * leaf.size
	end
	local stop = visible and check({step}, s, from, start, #s, big) or p
	local list = show_count(node, step.counter, cut(tvb, from - 1, stop - from), step.name, count, visible)
	for index = 0, count - 1 do
		local item = list
		if (visible or step.item.on) and not step.unnamed then
			stop = visible and check(step.steps, s, p, start, #s, big) or p
			item = add(list, step.item.field, cut(tvb, p - 1, stop - p))
			if visible then set_text(item, format("%s[%d]", step.name, index)) end
		end
		p = show_steps(item, step.steps, tvb, s, p, start, big, visible)
	end
	return p
end

-- Add every value of a valid message; return where it ends.
function show_steps(node, steps, tvb, s, p, start, big, visible)
	for index = 1, #steps do
		local step = steps[index]
		if step.leaves then
			p = p + (start - p) % step.alignment
			local leaves, put = step.leaves, big and add or add_le
			for place = 1, #leaves do
				local leaf = leaves[place]
				if leaf.count then
					show_numbers(node, leaf, leaf.counter, tvb, p + leaf.offset, leaf.count, big, leaf.name, visible)
				elseif visible or leaf.record.on then
					put(node, leaf.field, cut(tvb, p + leaf.offset - 1, leaf.size))
				end
			end
			p = p + step.size
		elseif step.steps then
			p = show_list(node, step, tvb, s, p, start, big, visible)
		else
			local from, length = p + (start - p) % 4, nil
			length, p = count_at(s, p, start, big)
			if visible or step.record.on then
				local range = cut(tvb, from - 1, 4 + length * step.width)
				add(node, step.record.field, range, text_value(step, s, p, length, big))
			end
			p = p + length * step.width
		end
	end
	return p
end

-- RACS2 messages: the header, and the values of the body, where it is a RACS2Bridge_std_msgs (Protocol Buffers), as the
-- public examples have.

local body_length = new_field("racs2", "racs2.body_length", "uint32", "body_length", base.DEC)
local VALUES = {}  -- by field number
for number, item in pairs(D.of_links.racs2.values) do
	local format_of = ({int64 = base.DEC, uint64 = base.DEC})[item.kind]
	VALUES[number] = {
		kind = item.kind, name = item.name, array = item.array, width = ({float = 4, double = 8})[item.kind],
		record = new_field("racs2", "racs2.body." .. item.name, item.kind, item.name, format_of),
	}
end

-- Read a varint at a place (from 1) of a string: its low and high 32 bits, and the place behind it; nil where it is cut.
local function varint(s, p, last)
	local low, high, shift = 0, 0, 0
	while p <= last and shift < 70 do
		local octet = byte(s, p)
		local bits = octet % 128
		for index = 0, 6 do
			local place = shift + index
			if math.floor(bits / 2 ^ index) % 2 == 1 then
				if place < 32 then low = low + 2 ^ place elseif place < 64 then high = high + 2 ^ (place - 32) end
			end
		end
		p, shift = p + 1, shift + 7
		if octet < 128 then return low, high, p end
	end
	return nil
end

-- Add the values of one field's bytes to a list; tell whether they are of its kind.
local function take_values(found, field, s, p, last)
	if field.kind == "string" then
		local text = s:sub(p, last)
		found[#found + 1] = {field = field, at = p - 1, size = last - p + 1, value = text}
		return utf8_text(text) == text
	elseif field.width then
		if (last - p + 1) % field.width ~= 0 or not (field.array or last - p + 1 == field.width) then return false end
		for at = p, last, field.width do
			found[#found + 1] = {field = field, at = at - 1, size = field.width}
		end
		return true
	end
	local first = p
	while p <= last do
		local low, high, behind = varint(s, p, last)
		if not low then return false end
		local value = field.kind == "bool" and low + high > 0
		if field.kind ~= "bool" then value = (field.kind == "int64" and Int64 or UInt64).new(low, high) end
		found[#found + 1] = {field = field, at = p - 1, size = behind - p, value = value}
		p = behind
	end
	return field.array or (#found > 0 and found[#found].at == first - 1)
end

-- Return the values from a place (from 0) to the end, or nil where the bytes are something else. Zeros end them.
local function body_values(s, at)
	local found, p, last = {}, at + 1, #s
	while p <= last and any_nonzero(s, p, last) do
		local key, _, behind = varint(s, p, last)
		if not key then return nil end
		local kind, field = key % 8, VALUES[math.floor(key / 8)]
		if not field then return nil end
		p = behind
		local stop
		if kind == 0 then
			local _, _, next_place = varint(s, p, last)
			stop = not (field.width or field.kind == "string") and next_place and next_place - 1
		elseif kind == 2 then
			local size, _, start = varint(s, p, last)
			if not size then return nil end
			p, stop = start, start + size - 1
		elseif kind == 1 or kind == 5 then
			stop = p + (kind == 1 and 8 or 4) - 1
		end
		if not stop or stop > last or not take_values(found, field, s, p, stop) then return nil end
		p = stop + 1
	end
	return #found > 0 and found or nil
end

-- A float as Python has it: as few digits as tell it from all others.
local function float_text(value)
	local text
	for digits = 15, 17 do
		text = format("%." .. digits .. "g", value)
		if tonumber(text) == value then break end
	end
	return text:find("^%-?%d+$") and text .. ".0" or text
end

-- The values of a message in one line.
local function body_text(values, s)
	local names, told = {}, {}
	for _, item in ipairs(values) do
		local field, text = item.field, tostring(item.value)
		if field.width then
			text = float_text((unpack(field.width == 8 and "<d" or "<f", s, item.at + 1)))
		elseif field.kind == "string" then
			text = "'" .. text .. "'"
		elseif field.kind == "bool" then
			text = item.value and "True" or "False"
		end
		if not told[field] then names[#names + 1] = field end
		local list = field.array and told[field] or {}
		list[#list + 1], told[field] = text, list
	end
	for index, field in ipairs(names) do
		local text = table.concat(told[field], ", ")
		names[index] = field.name .. " " .. (field.array and "[" .. text .. "]" or text)
	end
	return table.concat(names, ", ")
end

-- Add the values of a message, the last of each that is no array.
local function show_body(values, tree, tvb, visible)
	local newest = {}
	for _, item in ipairs(values) do newest[item.field] = item end
	for _, item in ipairs(values) do
		local field = item.field
		if (field.array or newest[field] == item) and (visible or field.record.on) then
			local range = item.size > 0 and cut(tvb, item.at, item.size) or cut(tvb, item.at - 1, 1)
			if field.width then
				add_le(tree, field.record.field, range)
			else
				add(tree, field.record.field, range, item.value)
			end
		end
	end
end

-- Read a RACS2 message: a MsgId, or the name of a topic; then the values of its body.
local function racs2(s)
	local to_cfs = byte(s, 1) * 256 <= D.limits.highest_msg_id
	if not take(to_cfs and L.racs2_message or L.racs2_topic, 0) then return nil end
	local size, values = #s - L.racs2_message.size, body_values(s, L.racs2_message.size)
	if W.listed then
		local target
		if to_cfs then
			target = format("0x%04x", (read.racs2_message(s, 1)))
		else
			target = read.racs2_topic(s, 1)
		end
		W.summary = target .. ": " .. (values and body_text(values, s) or size .. " bytes")
		if to_cfs and size > D.of_links.racs2.largest then
			W.summary = W.summary .. format(", more than the %d that cFS has room for", D.of_links.racs2.largest)
		end
	end
	W.inside[1] = function(node, tvb, visible)
		show_value(node, body_length, size, visible)
		if values then show_body(values, node, tvb, visible) end
	end
	return nil
end
HEADER_READERS.racs2 = racs2

-- Tell whether a message begins with a header of RACS2: a MsgId and zeros, or the name of a topic.
local function is_racs2(s)
	local size = D.layouts.racs2_message.size
	if #s < size then return false end
	local high, low = byte(s, 1, 2)
	local msg_id = high * 256 + low
	if msg_id > 0 and msg_id <= D.limits.highest_msg_id and not s:sub(3, size):find("[^\0]") then return true end
	if high ~= 47 and high ~= 126 and (high <= 64 or high >= 123) then return false end
	return not s:sub(1, size):find("[\128-\255]") and not s:sub(5, size):find('[ "]')
end
RECOGNISED.racs2 = is_racs2

local frames = (function()
-- CCSDS transfer frames and the packets in them, by the rules of edoras_tools.io.frames.transfer, which says what is
-- meant here. What a frame needs of those before it is noted when it is read first.

local LIMITS = D.frame_limits
local channels, noted = {}, {}  -- what is known of senders, and what was noted, by W.key
local form  -- how the frame that is read is made
local check = new_field("frames", "frames.frame_error_control", "uint16", "frame_error_control", base.HEX)

-- The count by which frames of a kind follow each other, and its values.
local COUNTS = {
	tm = {"master_channel_frame_count", 0x100}, aos = {"virtual_channel_frame_count", 0x1000000},
	tc = {"frame_sequence_number", 0x100},
}

-- Return how the bytes that come to a port are framed, or nil: by the destination's, of a stream by either end's.
local function format_at(pinfo)
	local stream = pinfo.port_type == TCP
	local found = D.frames[pinfo.dst_port]
	if stream and not (found and found.stream) then found = D.frames[pinfo.src_port] end
	return found and (found.stream or false) == stream and found or nil
end

-- Return the bytes of a frame that starts so, as its header has them; nil where none does.
local function stated_length(found, s)
	local layout = L[found.layout]
	if #s < layout.size then return nil end
	local values = {read[found.layout](s, 1)}
	if values[1] ~= found.version then return nil end
	local length = found.kind == "tc" and values[layout.place.frame_length] + LIMITS.tc_bias or found.length
	return length >= found.smallest and length or nil
end

-- Tell whether so many bytes are a frame, and remember its form.
local function is_frame(pinfo, s, length)
	form = format_at(pinfo)
	return form ~= nil and stated_length(form, s) == length
end

-- Read the headers of a frame: where its data starts and ends, where its first packet starts (nil for none), whether
-- it is idle, whether it has a count, and its count, spacecraft, channel and MAP.
local function read_headers_of(s)
	local start, stop = form.start, #s - (form.fecf and LIMITS.fecf_bytes or 0)
	local behind = s:sub(start + 1, start + 2) .. "\0\0"
	local map, counted, idle, pointer, count, craft, channel = 0, true, false, 0, 0, 0, 0
	local _, second, ocf
	add_layer(L[form.layout], 0)
	if form.kind == "tm" then
		local other
		_, craft, channel, ocf, _, count, second, other, _, _, pointer = read.tm_frame(s, 1)
		if second == 1 then
			take(L.tm_secondary, start)
			start = start + 1 + select(2, read.tm_secondary(behind, 1))
		end
		idle = pointer == LIMITS.only_idle or other == 1
	elseif form.kind == "aos" then
		local high
		_, craft, channel, count, _, _, high = read.aos_frame(s, 1)
		craft, ocf = craft + high * 256, form.ocf and 1 or 0
		take(L.aos_packets, start)
		_, pointer = read.aos_packets(behind, 1)
		start = start + L.aos_packets.size
		idle = channel == LIMITS.aos_idle or pointer == LIMITS.only_idle
	else
		local bypass, control
		_, bypass, control, _, craft, channel, _, count = read.tc_frame(s, 1)
		counted, idle = bypass == 0, control == 1
		if form.segments then
			take(L.tc_segment, start)
			local flags
			flags, map = read.tc_segment(behind, 1)
			pointer = flags % 2 == LIMITS.first_part and 0 or LIMITS.no_packet
			start = start + L.tc_segment.size
		end
	end
	if ocf == 1 then stop = stop - LIMITS.ocf_bytes end
	local first = not idle and pointer ~= LIMITS.no_packet and start + pointer or nil
	return start, stop, first, idle, counted, count, craft, channel, map
end

-- Follow the count of a channel; tell whether a frame came before with the same bytes.
local function came_before(known, count, s)
	local modulus = form.modulus
	local late = modulus == 256 and LIMITS.late or modulus / 2
	local step = (count - (known.last or count) + late) % modulus - late
	if math.abs(step) > D.limits.sequence_modulus / 2 then step = D.limits.sequence_modulus / 2 end
	known.last, known.position = count, (known.position + step) % D.limits.sequence_modulus
	sequence.follow(known.counts, {count = known.position, frame = W.key, body = s})
	return known.counts.again
end

-- Note what a frame needs of those before it: the rest of a packet, whether one was cut at its start, whether the
-- frame came before.
local function look_back(s, start, stop, first, counted, count, craft, channel, map)
	local places, port = sender(channels)
	local ends = nested(nested(places, port), tostring(W.pinfo.dst) .. " " .. W.pinfo.dst_port)
	local name = format("%d %d %s", craft, channel, counted)
	local known = ends[name]
	if not known then
		known = {position = 0, run = 0, counts = {strands = {}, place = 0}, maps = {}}
		ends[name] = known
	end
	if counted then
		if came_before(known, count, s) then return {again = true} end
		if known.joined and (count - known.joined) % form.modulus > 1 then known.run = known.run + 1 end
		known.joined = count
	end
	local parts, found = nested(known.maps, map), {rest = ""}
	if start == stop and parts.run ~= known.run then return found end  -- nothing that could go on
	if parts.run == known.run then
		found.rest = parts.rest
	elseif parts.run then
		found.cut = parts.rest ~= "" or (first or stop) > start
	end
	parts.run, found.parts = known.run, parts
	return found
end

-- Find the packets in the data of a frame behind the rest of one; idle ones are left out. Return where each starts and
-- its bytes, what is left at the end, and whether a packet was cut.
local function packets_in(data, pointers)
	local found, rest, cut = {}, "", false
	for index, place in ipairs(pointers) do
		local limit = pointers[index + 1] or #data + 1
		while place < limit and byte(data, place) < 32 do  -- another version is no space packet
			local size = limit
			if limit - place >= HEADER then
				local _, _, _, apid, _, _, data_length = read.ccsds(data, place)
				size = data_length + LENGTH_BIAS
				if apid ~= LIMITS.idle_apid and place + size <= limit then found[#found + 1] = {place, size} end
			end
			if place + size > limit then
				if index == #pointers then rest = data:sub(place) else cut = true end
				break
			end
			place = place + size
		end
	end
	return found, rest, cut
end

-- Read one frame; the packets that end in it are W.packets: {where in the frame, or nil; their bytes}.
local function read_frame(s)
	local start, stop, first, idle, counted, count, craft, channel, map = read_headers_of(s)
	local fits = idle and form.kind == "tc" or start <= stop and (first or -1) < math.max(stop, start + 1)
	if not fits then note("truncated") end
	local wrong
	if form.fecf and not W.cut then
		local at = #s - LIMITS.fecf_bytes
		local right = crc16(s, 1, at)
		wrong = right ~= byte(s, at + 1) * 256 + byte(s, at + 2)
		if wrong then note("checksum_bad") end
		W.inside[W.layers] = function(node, tvb, visible)
			if not (visible or check.on) then return end
			local item = add(node, check.field, cut(tvb, at, LIMITS.fecf_bytes))
			if wrong and visible then item:append_text(format(", but the frame has 0x%04x", right)) end
		end
	end
	if W.listed then
		W.summary = format("%s frame %d of channel %d", form.kind:upper(), count, channel)
	end
	if not fits or wrong or W.cut then return nil end
	if not W.pinfo.visited then
		noted[W.key] = look_back(s, start, idle and start or stop, first, counted, count, craft, channel, map)
	end
	local known = noted[W.key]
	if not known or known.again then return nil end
	local before = #known.rest
	local data = known.rest .. s:sub(start + 1, idle and start or stop)
	local pointers = {before > 0 and 1 or nil}
	if first then pointers[#pointers + 1] = before + first - start + 1 end
	local found, rest, cut_inside = packets_in(data, pointers)
	if known.parts then known.parts.rest, known.parts = rest, nil end
	if known.cut or cut_inside then note("stream_gap") end
	for index, item in ipairs(found) do
		local at = item[1] - before - 1 + start
		found[index] = {item[1] > before and at or nil, data:sub(item[1], item[1] + item[2] - 1)}
	end
	W.packets = found
	return nil
end
HEADER_READERS.frames = read_frame
RECOGNISED.frames = function() return false end  -- a mission has to say what they are

return {
	is_frame = is_frame,
	link = function() return link_by_label[form.link] end,
	forget = function() channels, noted = {}, {} end,
	head = function(pinfo)
		local found = format_at(pinfo)
		return found and L[found.layout].size
	end,
	length = function(s, pinfo) return stated_length(format_at(pinfo), s) end,
	likely = function(s, pinfo, behind)
		local found = format_at(pinfo)
		if found.fecf then return crc16(s, 1, #s) == 0 end
		local layout, count = L[found.layout], COUNTS[found.kind]
		if #behind < layout.size then return false end
		local one, other, place = {read[found.layout](s, 1)}, {read[found.layout](behind, 1)}, layout.place
		local next_one = (other[place[count[1]]] - one[place[count[1]]]) % count[2] == 1
		local same = other[place.virtual_channel_id] == one[place.virtual_channel_id]
		return one[place.spacecraft_id] == other[place.spacecraft_id]
			and (next_one or found.kind ~= "tm" and not same)
	end,
}
end)()

local fprime = (function()
-- The ground link of F Prime: frames, the packets in them, and with a dictionary the values in those, as
-- edoras_tools.addons.fprime reads them. Offsets count from the datagram's first byte, from 0.

local PRIME = D.of_links.fprime
local BOOK = D.dictionary or {described = {}, entries = {}, structs = {}, enums = {}}
local OWN, SPACE, TC_SHAPE, TM_SHAPE = 1, 2, 3, 4
local SHAPES = {  -- the header in front, and the bytes of the check at the end
	{L.fprime, "crc32", 4}, {L.fprime_space_packet, nil, 0}, {L.fprime_tc, "frame_error_control", 2},
	{L.fprime_tm, "frame_error_control", 2},
}
local CHECKS = {
	crc32 = new_field("fprime", "fprime.crc32", "uint32", "crc32", base.HEX),
	frame_error_control = new_field("fprime", "fprime.frame_error_control", "uint16", "frame_error_control", base.HEX),
}
local ENTRIES = {}
for kind, name in pairs(PRIME.entry_headers) do ENTRIES[kind] = L[name] end
local BLANK = ("\0"):rep(16)

-- Tell which shapes so many bytes may have: own, space packet, TC frame, TM frame. Not all of them may be there.
local function shapes(s, length)
	local have, head = #s, s:sub(1, 8) .. BLANK
	local own = have >= 4 and read.fprime(head, 1) == PRIME.start_word
	local version, _, secondary, apid, _, _, data_length = read.fprime_space_packet(head, 1)
	local space = have >= 8 and version == 0 and secondary == 0 and apid == read.fprime_packet(head, 7)
		and data_length + LENGTH_BIAS == length
	local control, frame_length
	version, _, control, _, _, _, frame_length = read.fprime_tc(head, 1)
	local tc = have >= 4 and version == 0 and control == 0 and frame_length + D.frame_limits.tc_bias == length
		and length >= L.fprime_tc.size + 2
	local _, second, other, order, segments, first
	version, _, _, _, _, _, second, other, order, segments, first = read.fprime_tm(head, 1)
	local tm = have >= 5 and version == 0 and second == 0 and other == 0 and order == 0 and segments == 3
		and length >= L.fprime_tm.size + 2 and (have < 6 or first < length or first >= D.frame_limits.only_idle)
	return own, space, tc, tm
end

RECOGNISED.fprime = function(s, length)
	local own, space, tc, tm = shapes(s, length)
	return own or space or tc or tm
end

-- Return the bytes of the frame, or of what keeps the stream alive, that starts so; nil where none does.
local function length_in_stream(s, pinfo)
	if s == PRIME.keep_alive then return #s end
	local framed = D.frames[pinfo.dst_port] or D.frames[pinfo.src_port]
	local tm_bytes = framed and framed.length or PRIME.tm_bytes
	local stated = select(7, read.fprime_tc(s, 1)) + D.frame_limits.tc_bias
	local inside = select(7, read.fprime_space_packet(s, 1 + L.fprime_tc.size)) + LENGTH_BIAS
	local is_tc = inside + L.fprime_tc.size + 2 == stated
	local own, _, tc, tm = shapes(s, is_tc and stated or tm_bytes)
	if own then return select(2, read.fprime(s, 1)) + L.fprime.size + 4 end
	return tc and is_tc and stated or tm and tm_bytes or nil
end

-- Values of a dictionary: each entry gets a field for each of its values, named as its topic.

local function add_records(records, members, prefix)
	for _, member in ipairs(members) do
		local name = prefix .. "." .. member.name
		local struct, kind = BOOK.structs[member.kind], member.kind
		if struct then
			add_records(records, struct, name)
		elseif kind == "string" or kind == "bool" or kind == "float" or kind == "double" then
			records[name] = new_field("fprime", name, kind, member.name)
		else
			records[name] = new_field(
				"fprime", name, kind, member.name, base.DEC, member.enum and BOOK.enums[member.enum]
			)
		end
	end
end

for _, entries in pairs(BOOK.entries) do
	for _, entry in pairs(entries) do
		entry.prefix, entry.records = entry.topic:sub(2):gsub("/", "."), {}
		add_records(entry.records, entry.members, entry.prefix)
	end
end

local CODES = {
	bool = ">B", uint8 = ">B", int8 = ">b", uint16 = ">I2", int16 = ">i2", uint32 = ">I4", int32 = ">i4",
	uint64 = ">E", int64 = ">e", float = ">f", double = ">d",
}
local taking  -- of the entry that is read: itself, its items, and where it must end
local take_member

-- Take one value at a place; return the place behind it, its word and the value; nil where it does not fit.
local function take_one(member, p, path, name)
	local s, last = W.s, taking.last
	local struct = BOOK.structs[member.kind]
	if struct then
		local told = {}
		for index, part in ipairs(struct) do
			local word
			p, word = take_member(part, p, path .. "." .. part.name, name .. "." .. part.name)
			if not p then return nil end
			told[index] = part.name .. "=" .. word
		end
		return p, "{" .. table.concat(told, ", ") .. "}"
	end
	local item = {path = path, record = taking.entry.records[name], at = p - 1}
	local word
	taking.items[#taking.items + 1] = item
	if member.kind == "string" then
		if p + 1 > last then return nil end
		local size = unpack(">I2", s, p)
		local room = taking.entry.padded and member.most or size
		if size > member.most or p + 1 + room > last then return nil end
		local text = D.text(s, p + 2, p + 1 + size)
		if utf8_text(text) ~= text then text = text:gsub("[\128-\255]", "?") end
		item.size, item.value = size + 2, text
		return p + 2 + room, item.value
	end
	if p + member.size - 1 > last then return nil end
	item.size, item.value = member.size, (unpack(CODES[member.kind], s, p))
	local value, names = item.value, member.enum and BOOK.enums[member.enum]
	if member.kind == "bool" then
		word = value ~= 0 and "True" or "False"
	elseif member.kind == "float" or member.kind == "double" then
		word = value ~= value and "nan" or format("%.9g", value)
	else
		word = names and names[tonumber(tostring(value))] or member.size < 8 and format("%d", value) or tostring(value)
	end
	return p + member.size, word, value
end

-- The same for one member, which may be an array.
function take_member(member, p, path, name)
	if not member.count then return take_one(member, p, path, name) end
	local told = {}
	for index = 1, member.count do
		p, told[index] = take_one(member, p, format("%s[%d]", path, index - 1), name)
		if not p then return nil end
	end
	return p, "[" .. table.concat(told, ", ") .. "]"
end

-- Say a number in a form of FPP, which is one of C; nil where it is not for it.
local function formed(spec, value, kind)
	local letter = spec:sub(-1)
	if letter:find("[CDO]") then letter = letter:lower() end
	local is_float = kind == "float" or kind == "double"
	if kind == "bool" then value = value ~= 0 and 1 or 0 end
	if letter:find("[efgEFG]") then
		if type(value) ~= "number" then value = tonumber(tostring(value)) end
	elseif is_float then
		if letter:find("%a") then return nil end
		spec, letter = spec .. "g", "g"
	elseif not letter:find("%a") then
		spec, letter = spec .. "d", "d"
	end
	if type(value) ~= "number" then  -- 64 bits
		local text = tostring(value)
		if letter:lower() == "x" then text = value:tohex():gsub("^0+(.)", "%1") end
		if letter == "X" then text = text:upper() end
		return (" "):rep((tonumber(spec:match("^%d+")) or 0) - #text) .. text
	elseif letter == "c" then
		return utf8_character(value)
	elseif value < 0 and letter:find("[xXo]") then
		return "-" .. format("%" .. letter, -value)
	end
	local done, text = pcall(format, "%" .. spec:sub(1, -2) .. letter, value)
	return done and text or nil
end

-- The text of an event with its arguments: {} says the next of them, and a brace that is meant is written twice.
local function event_text(entry, values, told)
	if not entry.format then return table.concat(told, " ") end
	local place = 0
	return (entry.format:gsub("([{}])([^{}]*)([{}])", function(open, spec, close)
		if open == close and spec == "" then return open end
		if open .. close ~= "{}" or not spec:find("^%d*%.?%d*[cdxoefgCDXOEFG]?$") then return nil end
		place = place + 1
		local value, kind = values[place], place <= #entry.members and entry.members[place].kind
		return spec ~= "" and value and CODES[kind] and formed(spec, value, kind) or told[place]
	end))
end

-- Read the values of an entry that start behind its ID; return where they end, or nil where they do not fit.
local function take_entry(entry, at, stop)
	taking = {entry = entry, items = {}, last = stop}
	local p = at + 1 + (entry.timed and PRIME.time_bytes or 0)
	local told, pairs_told, values = {}, {}, {}
	for index, member in ipairs(entry.members) do
		p, told[index], values[index] = take_member(member, p, member.name, entry.prefix .. "." .. member.name)
		if not p then return nil end
		pairs_told[index] = member.name .. "=" .. told[index]
	end
	if p - 1 > stop then return nil end
	local text = table.concat(entry.word == "channel" and told or pairs_told, " ")
	if entry.severity then text = (entry.severity .. " " .. event_text(entry, values, told)):gsub("%s+$", "") end
	return p - 1, entry.name .. (text ~= "" and ": " or "") .. text, taking.items
end

-- Show what was read, below the header that has its ID.
local function values_shower(text, items)
	return function(node, tvb, visible)
		if visible then node:append_text(": " .. printable(text)) end
		for _, item in ipairs(items) do
			if visible or item.record.on then
				local range = cut(tvb, item.at, item.size)
				local made
				if type(item.value) == "string" then
					made = add(node, item.record.field, range, item.value)
				else
					made = add(node, item.record.field, range)
				end
				if visible and item.path:find("[.%[]") then
					made.text = item.path .. made.text:gsub("^[^:]*", "", 1)
				end
			end
		end
	end
end

-- Read a header and what is told of it without a dictionary.
local function tell_header(layout, at)
	if not W.listed then return end
	local slot = layout.fields[1]
	local number = read[layout.name](W.s, at + 1)
	local name = slot.names and slot.names[number]
	local text = format(slot.hex and "0x%0" .. 2 * slot.size .. "x" or "%d", number)
	local title = layout == L.fprime_packet and "" or layout.title:gsub("^F Prime ", ""):lower() .. " "
	table.insert(W.told, title .. (name and format("%s (%s)", name, text) or text))
end

-- Read what a packet holds behind its type, by the dictionary.
local function entries_of(kind, at, stop)
	local layout, known = ENTRIES[kind], BOOK.entries[kind] or {}
	local width = layout.fields[1].size
	while true do
		if at + width > stop then return note("length_mismatch") end
		local entry = known[(unpack(">I" .. width, W.s, at + 1))]
		local behind, text, items
		if entry then behind, text, items = take_entry(entry, at + width, stop) end
		if at + layout.size <= stop then
			add_layer(layout, at, items and values_shower(text, items))
			if not items then tell_header(layout, at) end
		end
		if not entry then return note("unknown_msg_id") end
		if not behind then return note("struct_length") end
		table.insert(W.entries_read, entry)
		if W.listed then table.insert(W.told, text) end
		if behind >= stop then return end
		if entry.word ~= "channel" and entry.word ~= "event" then return note("length_mismatch") end
		at = behind
	end
end

-- Read one packet from a place to another; `space` is where the space packet around it starts. Tell whether it is whole.
local function packet(space, at, stop, fits)
	if space and space <= at - L.fprime_space_packet.size then add_layer(L.fprime_space_packet, space) end
	if stop - at < L.fprime_packet.size then return false end
	add_layer(L.fprime_packet, at)
	local kind = read.fprime_packet(W.s, at + 1)
	local behind, layout = at + L.fprime_packet.size, ENTRIES[kind]
	local whole = stop - behind >= (layout and layout.size or 0)
	if not (whole and fits and layout) then
		tell_header(L.fprime_packet, at)
	elseif BOOK.described[kind] then
		entries_of(kind, behind, stop)
	else
		add_layer(layout, behind)
		tell_header(layout, behind)
	end
	return whole and fits
end

-- Read the packets between two places of a CCSDS frame; idle ones are left out. Tell whether all are whole.
local function space_packets(at, stop)
	local all = true
	while at < stop do
		local inside, behind, idle = math.min(at + HEADER, stop), stop + 1, false
		if stop - at >= HEADER then
			local _, _, _, apid, _, _, data_length = read.ccsds(W.s, at + 1)
			behind, idle = at + data_length + LENGTH_BIAS, apid == D.frame_limits.idle_apid
		end
		if not idle then all = packet(at, inside, math.min(behind, stop), behind <= stop) and all end
		at = behind
	end
	return all
end

-- Read one frame and the packets in it.
local function read_ground_frame(s)
	W.told, W.entries_read = {}, {}
	local own, space, tc = shapes(s, #s)
	local shape = own and OWN or space and SPACE or tc and TC_SHAPE or TM_SHAPE
	local header, name, check_bytes = SHAPES[shape][1], SHAPES[shape][2], SHAPES[shape][3]
	if name and not take(header, 0) then return nil end
	local size = own and select(2, read.fprime(s, 1)) + header.size + check_bytes or #s
	if #s < header.size + check_bytes or size > #s then return truncated(header.name, 0, size) end
	local check = size - check_bytes
	if name then
		local right = own and crc32(s, 1, check) or crc16(s, 1, check)
		local wrong = right ~= unpack(">I" .. check_bytes, s, check + 1)
		if wrong then note("checksum_bad") end
		local record = CHECKS[name]
		W.inside[W.layers] = function(node, tvb, visible)
			if not (visible or record.on) then return end
			local item = add(node, record.field, cut(tvb, check, check_bytes))
			if wrong and visible then item:append_text(", which is wrong") end
		end
	end
	local whole
	if own then
		whole = packet(nil, header.size, check, true)
	else
		local first, ocf = 0, 0
		if shape == TM_SHAPE then
			local _
			_, _, _, ocf, _, _, _, _, _, _, first = read.fprime_tm(s, 1)
		end
		whole = space_packets((name and header.size or 0) + first, check - ocf * D.frame_limits.ocf_bytes)
	end
	if not whole then
		note("truncated")
	elseif size < #s then
		note("length_mismatch")
	end
	if W.listed then W.summary = #W.told > 0 and table.concat(W.told, "; ") or "no packet" end
	return nil
end
HEADER_READERS.fprime = read_ground_frame

return {
	length = length_in_stream, head = function() return #PRIME.keep_alive end,
	likely = function(s)
		if s == PRIME.keep_alive then return true end
		local own, _, tc, tm = shapes(s, #s)
		if own then return crc32(s, 1, #s - 4) == unpack(">I4", s, #s - 3) end
		return (tc or tm) and crc16(s, 1, #s) == 0
	end,
}
end)()

-- The dissector itself: read a datagram, fill the columns, and add to the tree what is asked for.

local edoras = P.edoras
for _, link in ipairs(D.links) do
	local what = "Further ports of the link " .. link.doc
	if link.label ~= "frames" then  -- what these are like is for a mission to say
		edoras.prefs[link.label .. "_ports"] = Pref.range(link.name .. " ports", "", what, 65535)
	end
end
edoras.prefs.extended_header = Pref.bool(
	"Extended header", D.extended_header, "Packets carry cFE's extended header"
)
edoras.prefs.short_telemetry_header = Pref.bool(
	"12-byte telemetry header", D.telemetry_header == 12, "Older cFE builds: no spare in the telemetry header"
)
edoras.prefs.msg_ids_of_version_2 = Pref.bool(
	"MsgIds of version 2", D.msg_id_version == 2, "cFE builds MsgIds with the extended header's subsystem"
)

-- Return the ports of a link, those of its preference among them.
local function ports_of(label, list)
	local found = label == "frames" and {} or port_set(edoras.prefs[label .. "_ports"])
	for _, port in ipairs(list) do found[port] = true end
	return found
end

local registered, streams = {}, {}
local STREAMS = {sbn = "tcp.port", fprime = "tcp.port", racs2 = "ws.port"}  -- where Wireshark looks for who reads what a stream holds

-- Let the links read what comes over TCP: the messages themselves, or what WebSocket frames hold.
local function register_streams()
	for _, entry in ipairs(streams) do DissectorTable.get(entry[1]):remove(entry[2], entry[3]) end
	streams = {}
	for label, list in pairs(D.stream_ports) do
		stream_ports[label] = ports_of(label, list)
		for port in pairs(STREAMS[label] and stream_ports[label] or {}) do
			streams[#streams + 1] = {STREAMS[label], port, P[label]}
			DissectorTable.get(STREAMS[label]):add(port, P[label])
		end
	end
	for port, form in pairs(D.frames) do
		if form.stream and not form.own then
			streams[#streams + 1] = {"tcp.port", port, P.frames}
			DissectorTable.get("tcp.port"):add(port, P.frames)
		end
	end
end

local function register_ports()
	local udp = DissectorTable.get("udp.port")
	for port in pairs(registered) do udp:remove(port, edoras) end
	registered = {}
	for label in pairs(ports) do
		ports[label] = ports_of(label, D.ports[label])
		for port in pairs(ports[label]) do registered[port] = true end
	end
	for port, name in pairs(D.left) do
		local other = not registered[port] and Dissector.get(name)
		if other then udp:add(port, other) end
	end
	for port, form in pairs(D.frames) do
		if not form.stream then registered[port] = true end
	end
	for port in pairs(registered) do udp:add(port, edoras) end
	register_streams()
	settle(edoras.prefs.extended_header, edoras.prefs.short_telemetry_header, edoras.prefs.msg_ids_of_version_2)
end

function edoras.prefs_changed()
	register_ports()
end

local begun = {}  -- by the two ends of a stream: that messages were found in it
local skipped = {}  -- by frame and bytes that are at hand: those before the first message, or true where more are needed

function edoras.init()
	peers, sequences, analysis = {}, {}, {}
	frames.forget()
	begun, skipped = {}, {}
	asked.last, passes[true].last, passes[false].last = math.huge, math.huge, math.huge
end

-- Forget what a datagram that the capture cut cannot be blamed for.
local function forgive()
	note("capture_cut")
	local kept = 0
	for index = 1, W.findings do
		local finding = W.found[index]
		if not FINDINGS[finding].unknowable then
			kept = kept + 1
			W.found[kept] = finding
		end
	end
	W.findings = kept
end

-- What people would say of a packet of which nothing more is known.
local function said_of(known)
	if not known then return W.stop or format("%d bytes", #W.s) end
	if W.code then
		local command = D.commands[known_id(W.msg_id)] and known.commands[W.code]
		return format("function code %d", W.code) .. (command and " " .. command.name or "")
	end
	return W.bare and "header only" or known.name or ""
end

-- The findings that are more than a note, the gravest first.
local function badges()
	local text = ""
	for rank = 3, 2, -1 do
		for index = 1, W.findings do
			local finding = FINDINGS[W.found[index]]
			if finding.rank == rank then text = text .. finding.badge .. "  " end
		end
	end
	return text
end

-- What the list says of a packet, and the part of it that is its message: what is wrong, and its values.
local function info()
	local known, head = W.known, W.kind
	local text = W.summary and printable(W.summary) or said_of(known)
	if known then
		local name = W.message and W.route.topic or name_of(known)
		if text == name then text = "" end
		head = known.heads[name]
		if not head then
			head = format(name == "" and "%s 0x%04x" or "%s 0x%04x %s", W.kind, W.msg_id, name)
			known.heads[name] = head
		end
	end
	if W.findings > 0 then text = badges() .. text end
	local missing = analysis[W.key]
	if missing then
		missing = type(missing) == "number" and format("[gap of %d]", missing) or "[" .. missing .. "]"
		text = text == "" and missing or text .. "  " .. missing
	end
	if not head then return text, text end
	return text == "" and head or head .. "  " .. text, text
end

local function show_word(node, record, tvb, at, size)
	local little = W.form.little
	local range = cut(tvb, at, size)
	if size == 8 then
		(little and add_le or add)(node, record.field, range)
	elseif record == F.crc then
		(little and add_le or add)(node, record.field, range)
	else  -- Wireshark would take 8 bytes
		add(node, record.field, range, little and range:le_uint64() or range:uint64())
	end
end

-- Add our own layer: the envelope, or a place for what we say of a packet without one.
local function show_own(tree, tvb, visible)
	local at = W.envelope
	local node
	if not visible then
		node = add(tree, edoras)
	elseif at then
		node = add(tree, edoras, cut(tvb, at, W.form.size), "EDORAS Envelope")
	else
		node = add(tree, edoras)
		set_generated(node)
	end
	for _, word in ipairs(at and W.form.words or {}) do
		local record = F[word.name]
		if visible or record.on then show_word(node, record, tvb, at + word.at, word.size) end
	end
	if W.crc_at and (visible or F.crc.on) then show_word(node, F.crc, tvb, W.crc_at, W.form.crc) end
	return node
end

local function show_message(tree, tvb, visible)
	local at, size, kind = W.body, W.body_end - W.body, W.message
	local record = kind and kind.record or F.body
	local node = tree
	if size > 0 and (visible or record.on) then node = add(tree, record.field, cut(tvb, at, size)) end
	if kind and (visible or kind.on) then show_steps(node, kind.steps, tvb, W.s, at + 1, at + 1, W.big, visible) end
end

local function show_findings(node, visible)
	for index = 1, W.findings do
		local finding = FINDINGS[W.found[index]]
		add_expert(show_value(node, F.finding, finding.label, visible), finding.expert)
	end
	local missing = analysis[W.key]
	if missing then
		local kind = type(missing) == "number" and "gap" or missing
		add_expert(show_value(node, F[kind], kind == "gap" and missing or true, visible), EXPERT[kind])
	end
end

local function show_facts(node, visible)
	show_value(node, F.link, W.link, visible)
	local known = W.known
	if known then
		show_value(node, F.msg_id, W.msg_id, visible)
		local name = name_of(known)
		if name ~= "" then show_value(node, F.name, name, visible) end
		local command = W.code and known.commands and known.commands[W.code]
		if command then show_value(node, F.command, command.name, visible) end
	end
	local route = W.route
	if route then
		show_value(node, F.topic, route.topic, visible)
		show_value(node, F.type, route.type, visible)
	end
	for _, entry in ipairs(W.entries_read or {}) do
		show_value(node, F.topic, entry.topic, visible)
		show_value(node, F.type, entry.type, visible)
	end
	if W.time then
		show_value(node, F.mission_time, W.time, visible)
		if D.time.epoch then show_value(node, F.mission_utc, os.date("!%FT%TZ", D.time.epoch + W.time), visible) end
	end
	if W.stop then show_value(node, F.stop, W.stop, visible) end
	if W.text and W.text ~= "" then show_value(node, F.text, W.text, visible) end
end

local CDR, SUBSCRIPTIONS, CFDP = L.cdr, L.sbn_sub, Dissector.get("cfdp")

-- Add every layer, outermost first; return where findings belong.
local function show(tree, tvb, visible)
	local ours, node = visible or asked.protocols.edoras, nil
	local layers, places = W.layer, W.at
	for index = 1, W.layers do
		local layout, at = layers[index], places[index]
		if layout == CDR and ours then node = show_own(tree, tvb, visible) end
		if visible or layout.on then
			local header = show_layout(tree, layout, tvb, at, visible)
			if layout == CDR then
				show_message(header, tvb, visible)
			elseif layout == SUBSCRIPTIONS then
				for entry = 0, W.entries - 1 do
					show_layout(header, L.subscription, tvb, at + layout.size + entry * L.subscription.size, visible)
				end
			elseif W.inside[index] then
				W.inside[index](header, tvb, visible)
			end
		end
	end
	if not ours then return tree end
	node = node or show_own(tree, tvb, visible)
	if W.padding and (visible or F.padding.on) then
		add(node, F.padding.field, cut(tvb, W.padding, #W.s - W.padding))
	end
	show_facts(node, visible)
	return node
end

local reported_len, captured_len, raw = Tvb.reported_len, Tvb.captured_len, Tvb.raw

-- What tells the messages of one frame apart: a packet out of a transfer frame may begin where that does.
local function key_of(number, tvb, inner)
	return number + (2 * tvb:offset() + (inner and 1 or 0)) / 0x400000
end

-- Read what is of a link, and show it; return what the packet list says of it.
local function dissect_as(link, s, tvb, pinfo, tree, wanted, inner)
	local visible, number, cut_off = wanted == "all", pinfo.number, reported_len(tvb) > #s
	local listed = has_columns(pinfo, visible, number) or visible or F.text.on
	begin(s, link.label, pinfo, key_of(number, tvb, inner), listed, cut_off)
	local room = link.receive_buffer
	-- cFS takes what the header says: what is cut behind that is no loss.
	if room and #s > room and not (link.to_cfs and select(7, read.ccsds(s, 1)) + D.limits.length_bias <= room) then
		note(link.over_receive_buffer)
	end
	local start = (HEADER_READERS[link.label] or read_headers)(s, link)
	if start then space_packet(start) end
	if cut_off then forgive() end
	local line
	if listed then line, W.text = info() end
	show_findings(wanted and show(tree, tvb, visible) or tree, visible)
	if W.pdu and W.pdu < #s then CFDP:call(cut(tvb, W.pdu):tvb(), pinfo, tree) end  -- it fills columns, too
	return line
end

local told = {}  -- what the list says of the last frame that had messages
local MOST_SHOWN = 4096  -- characters of a column

local function dissect(tvb, pinfo, tree)
	if pinfo.in_error_pkt then return 0 end  -- what an ICMP error quotes was not sent again
	local s = captured_len(tvb) > 0 and raw(tvb) or ""
	local framed = frames.is_frame(pinfo, s, reported_len(tvb))
	local link = framed and link_by_label.frames or link_of(pinfo, s, reported_len(tvb))
	if not link then return 0 end
	local wanted = look_who_asks(tree, pinfo.number)
	local line = dissect_as(link, s, tvb, pinfo, tree, wanted)
	local key = W.key
	local inner = framed and frames.link()
	for _, packet in ipairs(W.packets or {}) do
		local at, bytes = packet[1], packet[2]
		if inner.port_decides or likeness(inner, pinfo, bytes, #bytes) > 0 then
			local own = at and cut(tvb, at, #bytes):tvb() or ByteArray.new(bytes, true):tvb("Packet over frames")
			local more = dissect_as(inner, bytes, own, pinfo, tree, wanted, true)
			line = line and line .. "; " .. more
		end
	end
	if line then
		if told.number == pinfo.number and told.key < key then  -- a further message of one segment
			line = #told.line > MOST_SHOWN and told.line or told.line .. "; " .. line
		end
		told.number, told.key, told.line = pinfo.number, key, line
		local columns = pinfo.cols
		columns.protocol = link.name
		columns.info = line
	end
	return #s
end

-- Tell whether a whole message looks like one of SBN: a known type, and a size that agrees with what it holds.
local function likely_sbn(s)
	local size, kind = read.sbn(s, 1)
	local first, expected = L.sbn.size + 1, D.sbn.names[kind] and 0
	if kind == D.sbn.APP then
		expected = #s >= L.sbn.size + L.ccsds.size and select(7, read.ccsds(s, first)) + D.limits.length_bias
	elseif kind == D.sbn.PROTO then
		expected = L.sbn_proto.size
	elseif kind == D.sbn.SUB or kind == D.sbn.UNSUB then
		expected = #s >= L.sbn.size + L.sbn_sub.size and L.sbn_sub.size + read.sbn_sub(s, first) * L.subscription.size
	end
	return kind ~= D.sbn.NO_MSG and size == expected  -- zeros, of which payloads are full, would be messages
end

-- How messages that follow each other in a stream are told apart: bytes that tell the length of any, the length of the
-- one that starts at a place (nil where none does, and what is left is taken for one), and whether one is likely.
local FRAMINGS = {
	sbn = {
		head = function() return L.sbn.size end,
		length = function(s)
			local size = read.sbn(s, 1)
			return size >= 0 and L.sbn.size + size or nil
		end,
		likely = likely_sbn,
	},
	frames = frames, fprime = fprime,
}

-- Its low bits: the SYN of either end was seen. Older versions do not have it.
local known, from_start = pcall(function() return Field.new("tcp.completeness") end)
from_start = known and from_start
local LONGEST_SEARCH = 0x10000  -- bytes in which a message has to begin
-- Return how many bytes of what is at hand are before the first message that is whole and likely, and that another one
-- or the end follows; nil where there is none.
local function first_message(framing, s, pinfo)
	local head = framing.head(pinfo)
	local function whole(at)
		local length = #s - at + 1 >= head and framing.length(s:sub(at, at + head - 1), pinfo)
		return length and length > 0 and at + length - 1 <= #s and length
	end
	for at = 1, #s - head + 1 do
		local length = whole(at)
		local behind = length and s:sub(at + length, at + length + head - 1)
		if length and (#behind < head or framing.length(behind, pinfo))
			and framing.likely(s:sub(at, at + length - 1), pinfo, behind) then
			return at - 1
		end
	end
end

-- Return how many bytes are before the first message, where the capture begins inside a stream; true for more bytes.
local function skip(framing, tvb, pinfo)
	local s = raw(tvb)
	local key = pinfo.number .. ":" .. #s
	if pinfo.visited then return skipped[key] or 0 end
	local ends = format("%s %d %s %d", pinfo.src, pinfo.src_port, pinfo.dst, pinfo.dst_port)
	local seen = from_start and from_start()
	if begun[ends] or seen and seen.value % 4 > 0 then return 0 end
	local before = first_message(framing, s, pinfo)
	begun[ends] = before ~= nil
	skipped[key] = before or (pinfo.can_desegment == 0 or #s > LONGEST_SEARCH) and #s or true
	return skipped[key]
end

-- Wireshark puts the stream in order.
local function dissect_stream(framing)
	local function message_length(tvb, pinfo, offset)
		return framing.length(raw(tvb, offset, framing.head(pinfo)), pinfo) or tvb:reported_length_remaining(offset)
	end
	return function(tvb, pinfo, tree)
		local head = framing.head(pinfo)
		if not head then return 0 end
		local before = framing.likely and skip(framing, tvb, pinfo) or 0
		if before == true then
			pinfo.desegment_offset, pinfo.desegment_len = 0, DESEGMENT_ONE_MORE_SEGMENT
			return captured_len(tvb)
		elseif before == captured_len(tvb) then
			return before
		end
		dissect_tcp_pdus(before > 0 and tvb(before):tvb() or tvb, tree, head, message_length, dissect)
		if before > 0 and pinfo.desegment_len > 0 then pinfo.desegment_offset = pinfo.desegment_offset + before end
		return captured_len(tvb)
	end
end

for name, protocol in pairs(P) do
	protocol.fields = members[name]
	protocol.dissector = FRAMINGS[name] and dissect_stream(FRAMINGS[name]) or dissect
end
edoras.experts = experts
register_ports()
if P.racs2 then DissectorTable.get("ws.protocol"):add(D.of_links.racs2.subprotocol, P.racs2) end
DissectorTable.get("udp.port"):add_for_decode_as(edoras)
