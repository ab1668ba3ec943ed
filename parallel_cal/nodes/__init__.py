"""The only modules that import rclpy."""
